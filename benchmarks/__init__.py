"""What computing, coding and flying take on a machine: `make bench` writes the tables of docs/performance.md."""
