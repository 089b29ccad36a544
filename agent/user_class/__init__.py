"""A class of the user in place of the controller: its calls, what it knows, what it returns."""
