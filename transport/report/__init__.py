"""Summary, figures, animation and bags of recorded runs."""
