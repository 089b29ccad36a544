"""Summary, figures, animation and Foxglove copy of recorded runs."""
