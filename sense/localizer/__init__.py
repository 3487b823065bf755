"""The localizer: from the readings of presses to their positions.

Letters of shapes mean the same in all of its modules: Q presses, C fibres, F features of a fibre in a press and G
modulations of its sensitivity, J values of its history, K timed windows (`moments`), T measures (depth and force),
N = 2 + T targets, L numbers of failed fibres (from 0), S nodes along a side of a response table, P positions of a
coarser grid, D discriminants of a fibre; of the networks E members, I inputs, H hidden units and B presses in a batch.
For those of other rooms see `docs/glossary.md`.
"""
