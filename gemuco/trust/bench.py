"""The newest blocks of one body, and all that they are judged with: the evidence under any hypothesis about them."""

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from gemuco.schema import BodySchema
from gemuco.trust.alternatives import Alternatives, is_another
from gemuco.trust.changes import LONGEST, LastingTest
from gemuco.trust.config import Hidden, TrustConfig
from gemuco.trust.evidence import Evidence, Judge
from gemuco.trust.healthy import PRIOR, Healthy
from gemuco.trust.hypotheses import SEARCHED
from gemuco.trust.jumps import EARLIER, TOGETHER, moved_alone
from gemuco.trust.recent import Recent, View
from gemuco.trust.relations import Relations
from gemuco.trust.tool import JudgedTool

WAITS = 100
"""Steps are learned as healthy after this number of blocks, unless something is hidden until then: a lie that is not
noticed at once would raise the limits above itself. They are at once at the start, and outside of what was learned."""
LATELY = 10
"""An alarm is new within this number of blocks after the change that caused it."""
OUTSIDE = 1.8
"""A sample is outside of what was learned if the model's errors are expected to be this multiple of those inside."""
BLAMED = 0.8
"""Of some columns that jumped, one has at least this share of the largest evidence."""
DOUBTFUL, PLAIN, AMONG = 0.4, 1.5, 0.5
"""From the first share of an alarm on, two wrong columns may hide each other; without one of them the other reaches the
second multiple of an alarm. One of them has at least the third share of the largest evidence."""
FAR_BETTER = 0.2
"""A p that held all the time has errors of at most this share of those of the p so far."""


class Bench:
    """Blocks, relations, limits and tests.

    Attributes:
        tool: The model to judge by.
        relations: Its relations.
        recent: The newest blocks.
        healthy: What is known of the errors of this body.
        judge: Limits and tests by what is healthy.
        lasting: The test of changes that last longer than the newest blocks.
        view: Errors of the newest blocks without the hidden columns; None before the first block.
        lied_when_settled: Whether the errors at the posture in which the body rests may be those of a lie with another
            cause than the one that was hidden; then they are no excuse for those at the same posture.
        place: Position in the layout -> column.
        environment: The columns of p.
    """

    def __init__(self, tool: JudgedTool, relations: Relations, config: TrustConfig) -> None:
        """Begin without blocks, for a model whose normal errors are known."""
        schema, size = tool.schema, len(relations.columns)
        signals = len(np.unique(relations.signals[: relations.count]))
        assert schema.normal is not None
        self.tool, self.relations, self._config = tool, relations, config
        self.recent, self.healthy, self.lasting = Recent(signals), Healthy(size, signals), LastingTest(size)
        self.view: View | None = None
        self.lied_when_settled = False
        self._outside: deque[bool] = deque(maxlen=LONGEST)
        """Whether each of the newest blocks is outside of what was learned, where errors of any size are healthy."""
        self._least = relations.sizes(schema, config)
        self._biases = np.unique(schema.normal.rows[:, schema.layout.size :], axis=0)
        self.place = {int(position): column for column, position in enumerate(relations.columns)}
        self.environment = frozenset(range(relations.count, size))
        self._steps: deque[np.ndarray] = deque()
        """What `Healthy.add_steps` will learn, oldest first."""
        self.refresh()

    def refresh(self) -> None:
        """Let the limits follow the healthy errors."""
        self.judge = Judge(self.healthy, self._config.false_alarms, self._least)
        self.recent.lag, self.recent.apart = self.healthy.lag, self.healthy.apart

    @property
    def schema(self) -> BodySchema:
        """The model to judge by."""
        return self.tool.schema

    @property
    def error(self) -> np.ndarray:
        """Errors of a healthy prediction of the newest block [standard deviations], shape (columns,)."""
        assert self.view is not None
        return np.asarray(self.view.healthy[-1] * self.judge.scale)

    @property
    def is_known_tool(self) -> bool:
        """Whether what is healthy was learned with the tool or load in use."""
        return self._is_known(self.schema)

    @property
    def beyond(self) -> Hidden:
        """Columns whose newest values are outside of what was learned."""
        return self.relations.beyond(self.schema, self.recent.values()[-1])

    def was_outside(self, age: int) -> bool:
        """Whether the body was outside of what was learned shortly before the newest `age` blocks."""
        before = list(self._outside)[: max(len(self._outside) - age, 1)]
        return any(before[-EARLIER:])

    def _is_known(self, schema: BodySchema) -> bool:
        return not is_another(self.schema, schema.bias, self._biases).all()

    def look(self, hidden: Hidden, motion: float, since: int) -> Evidence:
        """Judge the newest block.

        Args:
            hidden: Columns that are hidden or missing.
            motion: Motion in the block [looks at a new posture].
            since: Newly hidden columns have lied for about this number of blocks.
        """
        before = self.view
        if before is not None and before.hidden - hidden:
            self.recent.unsettle()  # one that returns may have lied when the body settled
        view = self.view = self.shown(hidden)
        if before is not None and hidden - before.hidden - self.recent.missing():
            self._steps.clear()
        if before is None or before.hidden != hidden:
            self.lasting = LastingTest(len(self.relations.columns))
            view = self.view = self._compared(view, before, since)
        outside = self.relations.outside(self.schema, self.recent.values()[-1:], view.z[-1:] * view.healthy[-1:])
        self._outside.append(bool(outside > OUTSIDE) and not self.relations.is_linear)
        self.recent.find_repeats(view, self.judge.scale, motion)
        is_blind = bool(self.recent.resting) or self._outside[-1]  # at rest sensor noise is no motion
        looks = 0.0 if is_blind else motion
        predicted = self.recent.predicted(view)
        predicted[list(self.environment)] = 0.0  # p has no gain
        self.lasting.add(view.standard(self.judge.scale)[-1], predicted, self.judge.least, looks / self.judge.time)
        return self.judge(view, self.lasting)

    def _compared(self, view: View, before: View | None, since: int) -> View:
        """Return a view with newly hidden columns, in which errors are usual that were there before they lied."""
        known = self.recent.usual
        if before is None or not before.hidden < view.hidden:
            self.recent.usual = {columns: usual for columns, usual in known.items() if columns <= view.hidden}
            return view
        usual = view.usual(self.judge.scale, since + EARLIER)
        known[view.hidden] = usual * known.get(view.hidden, 1.0)
        return view.scaled(usual)

    def without(self, hidden: Hidden, age: int = LONGEST) -> Callable[[Hidden], Evidence]:
        """Return the evidence with more columns hidden; errors are usual that were there before `age` blocks."""

        def without(more: Hidden) -> Evidence:
            view = self.shown(hidden | more)
            return self.judge(view.scaled(view.usual(self.judge.scale, age + EARLIER)))

        return without

    def hides_another(self, ratio: np.ndarray, hidden: Hidden) -> bool:
        """Whether one of the columns with the most evidence hides another one that is wrong too.

        Outside of what was learned all predictions are wrong, and fewer columns may not show that it is outside.
        """
        if any(self._outside):
            return False
        without, least = self.without(hidden), AMONG * float(ratio.max())
        order = [int(column) for column in np.argsort(-ratio)[:SEARCHED] if ratio[column] >= least]
        return any(without(frozenset({column})).highest >= PLAIN for column in order)

    def shown(self, hidden: Hidden) -> View:
        """Return the errors of the newest blocks with some columns hidden."""
        view = self.recent.view(self.relations, hidden)
        return replace(view, settled=np.full_like(view.settled, np.nan)) if self.lied_when_settled else view

    def alternatives(self, hidden: Hidden) -> Alternatives:
        """Return other readings of the newest blocks."""
        return Alternatives(self.schema, self.relations, self.recent, self.judge, hidden)

    def conditions(self, hidden: Hidden, age: int) -> Iterator[tuple[str, Evidence, bool]]:
        """Yield each other trained condition, and the model's own p if it is another tool's; see `explain`."""
        schema, alternatives = self.schema, self.alternatives(hidden)
        others = {name: schema.under(name) for name in schema.biases}
        if self.tool.proposed is not None and self.tool.is_another:
            others[""] = self.tool.proposed
        for name, other in others.items():
            if not np.array_equal(other.bias, schema.bias):
                yield name, alternatives.under(other, age), self._is_known(other)

    def under_proposed(self, hidden: Hidden, evidence: Evidence) -> float:
        """Return the largest evidence if the model's own p holds since the most likely change, or all the time.

        Of the p of a trained tool only measured columns count: normal errors that were learned with one tool take its p
        for certain. A tool that was changed long ago has errors that may be taken for healthy by now; then nothing
        changed lately, and the right p is known by its much smaller errors. Another p may be that of a lie.
        """
        proposed = self.tool.proposed
        assert proposed is not None
        alternatives, measured = self.alternatives(hidden - self.environment), slice(self.relations.count)
        trained = np.array(list(proposed.biases.values()))
        if not len(trained) or is_another(proposed, proposed.bias, trained).all():
            return alternatives.under(proposed, evidence.newest).highest
        since = alternatives.under(proposed, evidence.newest, measured)
        always, share = alternatives.always(proposed, measured)
        return min(since.highest_of(measured), always.highest_of(measured) if share < FAR_BETTER else np.inf)

    def sudden(self, age: int) -> Hidden:
        """Return the columns that jumped within about the newest `age` blocks while all others moved as usual."""
        return self.recent.jumps.sudden(age, self.error)

    def moved_alone(self, age: int) -> Hidden:
        """Return the element that moved within about the newest `age` blocks while all others rested."""
        count, values = self.relations.count, self.recent.values()
        left = self.beyond - self.relations.beyond(self.schema, values[0])
        return moved_alone(values[-age - EARLIER :, :count], self.error[:count], left)

    def jumped(self, age: int) -> Hidden:
        """Return all columns that jumped since about `age` blocks; none if that is long ago, or after a knock."""
        return self.recent.jumps.jumped(age, self.error, self.relations.signals) if age <= LATELY else frozenset()

    def began_with(self, evidence: Evidence) -> Hidden:
        """Return all columns whose jumps began an alarm.

        Few columns that contradict the others less than another one does only began to move.
        """
        jumped = self.jumped(evidence.newest)
        is_cause = any(evidence.ratio[column] >= BLAMED * evidence.highest for column in jumped)
        return jumped if is_cause or len(jumped) > TOGETHER else frozenset()

    def learn(self, evidence: Evidence, motion: float) -> None:
        """Learn what is healthy from the newest block."""
        view = self.view
        assert view is not None
        noise, z, hidden = view.noises[-1].copy(), view.z.copy(), list(view.hidden)
        z[:, hidden], noise[hidden] = np.nan, np.nan
        self.recent.jumps.learn(view.hidden)
        late = None if self._outside[-1] else view.late  # errors of a model out there are of any sign
        if np.isfinite(z[-1]).any():
            self.healthy.add(z, evidence.step, noise, motion, late, self.recent.lag)
            self._steps.append(np.where(np.isfinite(z[-1]), evidence.step, np.nan))
        is_at_once = self.healthy.count < PRIOR or any(self._outside)
        while len(self._steps) > (0 if is_at_once else WAITS):
            self.healthy.add_steps(self._steps.popleft())
