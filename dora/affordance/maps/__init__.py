"""Which part of an object is where, which part a hand touches, and the vote between the two."""
