"""Teams that no file describes: of any size by a ring, or drawn at random."""
