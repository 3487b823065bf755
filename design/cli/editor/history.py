"""What was drawn, step by step: done, undone and done again."""

from .course_edits import Courses

MOST_STEPS = 1000
"""That are remembered."""


class History:
    """The courses as they are, and as they were before.

    Attributes:
        now: the courses.
    """

    def __init__(self, begin: Courses) -> None:
        self.now = begin
        self._before: list[Courses] = []
        self._after: list[Courses] = []
        self._saved = begin
        self._gesture = ""

    def do(self, courses: Courses, gesture: str = "") -> None:
        """These are the courses from now on; what belongs to one gesture, such as a drag, is one step."""
        if not gesture or gesture != self._gesture:
            self._before = [*self._before, self.now][-MOST_STEPS:]
        self.now, self._after, self._gesture = courses, [], gesture

    def undo(self) -> None:
        """Take the last step back, if there is one."""
        if self._before:
            self._after.append(self.now)
            self.now, self._gesture = self._before.pop(), ""

    def redo(self) -> None:
        """Take the step again that was taken back last, if there is one."""
        if self._after:
            self._before.append(self.now)
            self.now, self._gesture = self._after.pop(), ""

    def keep(self, courses: Courses) -> None:
        """These were saved."""
        self._saved = courses

    @property
    def unsaved(self) -> bool:
        """Whether something has changed since it was saved, or begun."""
        return self.now is not self._saved

    @property
    def steps(self) -> tuple[int, int]:
        """How many can be taken back, and taken again."""
        return len(self._before), len(self._after)
