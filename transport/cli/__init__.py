"""Command line: a module for each command or family of commands, imported when one is called."""
