"""Compiled kernels: pure functions on arrays, in grid units.

Arguments that several of them share:

    along, across    knots along and across each fibre's axis; shape (F, n) of a pad, (P, F, n) of a population
    slope            slopes of the PCHIP curves at the knots, of the same shape
    horizontals      number of fibres, the first ones, that run along x; F is the number of all
    t, v, d          one fibre's row of along, across and slope; shape (n,)
    presses          x and y; shape (Q, 2); ct, cv are the coordinates of one along and across a fibre's axis
    ends, law        `Ends` and `WeightLaw` of `geometry`; max_offsets (P, 2) is from the function of that name
    chains, extents  a press in the frame of each family, from `frame_shape`; `select_frame` returns those of one
    span             a piece of a fibre from the press centre: r, h, e0..e3 of `exact_signals`; shape (6,)
    begin, end       the first index to compute, counted through the population, and the one to stop before
    scratch          work arrays of one thread, from `make_scratch`
"""
