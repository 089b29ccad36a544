"""3D viewer of a run in the browser."""
