"""Detection of faulty fibres from readings alone.

Letters of shapes mean the same in all of its modules: Q presses, R readings, C fibres of the pad and L living ones of
them, N inputs and T targets of a fibre, D components of its response, S steps within a trace, H hypotheses, K numbers
of failed fibres; of the networks E members and H hidden units. For those of other rooms see `docs/glossary.md`.
"""
