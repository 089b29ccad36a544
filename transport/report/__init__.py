"""Reports of a recorded run: summary, figures, animation, comparison, Foxglove export."""
