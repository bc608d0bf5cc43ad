"""Loops over candidates compiled by Numba: the hand, the distance field, the grasp energy, quasi-static closing.

A candidate has about a hundred points, too few for tensor operations to outweigh their overhead. Functions here take
plain arrays; `dora.affordance.search.compiled` and `dora.affordance.search.quasi_static_closing` are their interface
to tensors. Lengths are in [m]; poses (3, 4) are matrices (R | t) in the object frame; a wrench (6,) is a force [N]
and its moment [N m] about the origin of that frame.

Numba caches compiled functions on disk and invalidates them by their own file alone: after a change to a function
that others call, delete `dora/affordance/search/native/__pycache__`.
"""
