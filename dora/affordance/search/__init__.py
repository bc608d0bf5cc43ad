"""From an object to grasp candidates: energies, initial poses, descent, and what is measured of the result."""
