"""What a scenario describes, built by every process identically: bodies, reference, laws, cost."""
