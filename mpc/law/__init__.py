"""The law of the team: gains about hover and along a reference, preview, and what changes it."""
