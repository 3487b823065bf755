"""What figures share: the cells of a confusion matrix."""

from padforge.common.plotting import draw_confusions, new_figure


def test_confusions_are_in_per_cent_of_each_true_class():
    _, axes = new_figure(3, 3)
    draw_confusions(axes, [[3, 1], [8, 32]])
    written = {text.get_position(): text.get_text() for text in axes.texts}  # column and row
    assert written == {(0, 0): "75", (1, 0): "25", (0, 1): "20", (1, 1): "80"}
