import numpy as np

from sense.rig.adaptive import uncertainty


def test_presses_go_where_errors_are_large_and_nothing_was_pressed():
    known = np.array([[x, y] for x in range(-4, 5) for y in range(-4, 5)], float)
    errors = np.where(known[:, 0] > 0, 5.0, 0.5)
    here, there, beside = [3.5, 0.5], [-3.5, 0.5], [3.0, 0.05]
    worth = uncertainty(np.array([here, there, beside]), known, errors, known)
    assert worth[0] > 5 * worth[1]
    assert worth[0] > 5 * worth[2]


def test_a_place_just_chosen_is_not_chosen_again():
    known, errors = np.zeros((1, 2)), np.ones(1)
    candidates = np.array([[3.0, 0.0], [-3.0, 0.0]])
    first = uncertainty(candidates, known, errors, known)
    again = uncertainty(candidates, known, errors, np.vstack([known, candidates[:1]]))
    assert first[0] == first[1]
    assert again[0] == 0 < again[1]
