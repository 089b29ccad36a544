"""What a person touches: command line, local harness, recording, metrics, figures."""
