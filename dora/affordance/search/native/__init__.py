"""Row by row in compiled loops: the hand, the distance field, the grasp energy and the closing hand.

A candidate has some hundred points, too few for tensor operations to be worth their overhead. Functions here take
plain arrays; `dora.affordance.search.compiled` and `dora.affordance.search.quasi_static_closing` are their interface
to tensors. Lengths are in metres, poses (3, 4) are matrices [R | t] in the object frame, a wrench (6,) is a force [N]
and its moment [N m] about the origin of that frame.

Numba keeps what it compiled on disk and looks only at the file of a function: after a change to a function that others
call, delete `dora/affordance/search/native/__pycache__`.
"""
