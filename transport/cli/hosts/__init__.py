"""Commands for several hosts: deployment folders, and each process by itself."""
