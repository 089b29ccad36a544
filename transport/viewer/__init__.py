"""What people see of a run in space: the scene at any instant, and the browser that shows it."""
