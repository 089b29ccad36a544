"""The comparison of the paper: centralized against distributed control."""
