"""Grasp search: energies, initial poses, descent, quasi-static closing, and the measurement of what results."""
