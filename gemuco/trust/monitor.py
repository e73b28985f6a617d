"""The monitor: it judges every element block by block, and hides those that lie until they have agreed again."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace

import numpy as np

from gemuco.anomaly.blame import parts
from gemuco.schema import BodySchema
from gemuco.trust.alternatives import Alternatives, is_another
from gemuco.trust.cases import Case, LastSearch, describe, has_moved
from gemuco.trust.changes import LONGEST, LastingTest
from gemuco.trust.config import BLOCK, Finding, Hidden, TrustConfig
from gemuco.trust.evidence import Evidence, Judge
from gemuco.trust.healthy import Healthy
from gemuco.trust.hypotheses import SEARCHED, Cause, explain, remaining
from gemuco.trust.jumps import EARLIER
from gemuco.trust.recent import Recent, View
from gemuco.trust.relations import Relations

CONFIRMED = 2
"""The same cause must explain this number of successive blocks before it is hidden."""
CALM = 0.6
"""Elements agree if the evidence against all is below this share of an alarm."""
LEARNING = 0.8
"""What is healthy is learned only from blocks with less evidence than this."""
REFRESH = 10
"""Limits follow the healthy errors once in this number of blocks."""
AGAIN = 5
"""Hidden elements are judged anew, and a cause that cannot be hidden is searched for, once in this number of blocks."""
RARELY = 20
"""A body that is not known to be as the model says is searched once in this number of blocks."""
SETTLED = 25
"""A cause and its kind may be corrected for this number of blocks."""
OTHER = 100.0
"""After this number of blocks of motion in which no element explains what is seen, the body counts as another one: what
is healthy is learned from it, and small lies are noticed no more."""
STRANGE = 1.8
"""If the errors without a cause are usually this multiple of those that were learned, no sensor is hidden."""
LAPSES = 10
"""A suspicion ends if nothing speaks for it in this number of blocks."""
DOUBTFUL, PLAIN, AMONG = 0.4, 1.5, 0.5
"""From the first share of an alarm on, two wrong columns may hide each other; without one of them the other reaches the
second multiple of an alarm. One of them has at least the third share of the largest evidence."""
UNEXPLAINED, ONCE_MORE = 3, 100
"""If this number of searches found no cause, those hidden in this number of blocks were no cause either."""
GROSS, LONG, LIKE = 3.0, 50.0, 1.3
"""On a body that is not known to be as the model says, a lie is hidden if it is the first multiple of an alarm, is a
jump or explains the second number of blocks of motion, and leaves errors below the third multiple of those learned."""
MOVED = 30.0
"""A body is not known before it has moved for this number of blocks, with this tool: at rest it shows one posture."""
AT_ONCE, ONCE = 3, 15
"""At most this number of elements are wrong at once, which is within this number of blocks; otherwise the body is."""
LATELY, SUSPECT = 10, 0.6
"""Of an element that jumped within the first number of blocks, the second share of an alarm is one: with limits for one
wrong verdict a week, so much less evidence is enough if a jump of a right element comes once in 20 minutes at most."""
PATIENCE = 100
"""An element that jumped away returns after this number of blocks, or after it has jumped back."""
Replaces = Callable[[frozenset[int]], bool]
"""Whether all elements of a set can be estimated while none of them is measured."""


class TrustMonitor:
    """Sequential tests of all elements of one body.

    Give it every block of samples, also the values of hidden elements, because they show when an element agrees again.
    """

    def __init__(
        self,
        schema: BodySchema,
        config: TrustConfig | None = None,
        devices: Iterable[frozenset[int]] = (),
        replaces: Replaces = lambda elements: True,
    ) -> None:
        """Prepare.

        Args:
            schema: The model in use.
            config: The settings.
            devices: Positions of the elements that each device measures.
            replaces: Whether a set of elements can be estimated.
        """
        self._config, self._devices, self._replaces = config or TrustConfig(), list(devices), replaces
        self.is_known = True
        """Whether the model's normal errors are known to be those of this body."""
        self._recent, self._count, self._now = Recent(), 0, 0.0
        self._by_hand: dict[int, float] = {}
        self._immune: set[int] = set()
        self._cases: list[Case] = []
        self._relations: Relations | None = None
        self._schema: BodySchema | None = None
        self._healthy, self._met, self._met_at = Healthy(0), schema.bias, 0.0
        self.use(schema)

    def use(self, schema: BodySchema) -> None:
        """Judge by another model; what is known of the body is kept unless the normal errors were learned anew."""
        before, self._schema = self._schema, schema
        if before is not None and before.normal is schema.normal:
            if is_another(schema, schema.bias, self._met[None])[0]:
                self._met, self._met_at = schema.bias, self._healthy.moved
            return
        self._met, self._met_at = schema.bias, 0.0
        self._relations = Relations.of(schema)
        self._view: View | None = None
        if self._relations is None:
            return
        assert schema.normal is not None
        self._biases = np.unique(schema.normal.rows[:, schema.layout.size :], axis=0)
        size = len(self._relations.columns)
        self._recent.clear()
        self._other = self._motion = self._alarmed = 0.0
        self._search, self._missing = LastSearch(), Hidden()
        self._healthy, self._lasting = Healthy(size), LastingTest(size)
        self._least = self._relations.sizes(schema, self._config)
        self._judge = self._fresh_judge()
        place = {int(position): column for column, position in enumerate(self._relations.columns)}
        self._place = place
        self._environment = frozenset(range(self._relations.count, size))
        movable = [int(p) for p in self._relations.columns[: self._relations.count]]
        self._parts = [frozenset(place[p] for p in part) for part in parts(schema, movable)]
        self._joined = [frozenset(place[p] for p in device if p in place) for device in self._devices]

    @property
    def hidden(self) -> frozenset[int]:
        """Positions in the layout that must not be used as measured."""
        return frozenset(self._by_hand) | frozenset(p for case in self._cases if case.is_hidden for p in self._at(case))

    @property
    def is_ready(self) -> bool:
        """Whether lies can be noticed: what is normal is known, and enough blocks were seen."""
        return self._relations is not None and self._healthy.is_known

    def _is_known_body(self, columns: Hidden = frozenset()) -> bool:
        """Whether what is healthy is known of this body, with this tool, in motion; of some columns, or of all."""
        assert self._schema is not None
        if any(case.is_hidden and case.changes(columns, self._parts) for case in self._cases):
            return False
        has_moved = self._healthy.moved - self._met_at >= MOVED
        return self.is_known and has_moved and not is_another(self._schema, self._schema.bias, self._biases).all()

    @property
    def findings(self) -> tuple[Finding, ...]:
        """Everything that is suspected or hidden, the oldest first."""
        by_hand = [
            Finding((position,), "element", "unknown", since, is_distrusted=True, by_hand=True)
            for position, since in self._by_hand.items()
        ]
        return (*by_hand, *(self._finding(case) for case in self._cases))

    def distrust(self, position: int, now: float) -> None:
        """Hide an element until `trust`."""
        self._immune.discard(position)
        self._by_hand[position] = now

    def trust(self, position: int) -> None:
        """Use an element again; it is not hidden again before it has agreed with the others once."""
        self._by_hand.pop(position, None)
        cases = [case for case in self._cases if position in self._at(case)]
        for case in cases:
            self._cases.remove(case)
            self._immune.update(self._at(case))

    def add(self, samples: np.ndarray, now: float) -> None:
        """Judge one block.

        Args:
            samples: All samples of the last `BLOCK` seconds [standard deviations], hidden elements included, shape
                (n, size); NaN where not measured.
            now: Time of the last sample [s].
        """
        if self._relations is None or self._schema is None or not len(samples):
            return
        self._count, self._now = self._count + 1, now
        self._recent.add(self._schema, self._relations, samples)
        motion = self._motion = self._healthy.motion(self._recent.moved())
        self._recent.rest(motion, self._healthy.looks)
        is_steady, self._missing = self._missing == self._recent.missing(), self._recent.missing()
        hidden = self._hidden_columns() | self._missing
        before = self._view
        if before is not None and before.hidden - hidden:
            self._recent.unsettle()  # one that returns may have lied when the body settled
        view = self._view = self._recent.view(self._relations, hidden)
        if before is None or before.hidden != hidden:
            self._lasting = LastingTest(len(self._relations.columns))
            view = self._view = self._compared(view, before)
        if self._count % REFRESH == 0:
            self._judge = self._fresh_judge()
        self._recent.find_repeats(view, self._judge.scale, motion)
        looks = 0.0 if self._recent.resting else motion  # at rest sensor noise is no motion
        self._lasting.add(view.z[-1] / self._judge.scale, self._judge.least, looks / self._judge.time)
        evidence = self._judge(view, self._lasting)
        if self._healthy.is_known:
            self._decide(evidence, hidden, is_steady)
        is_other = any(case.cause.cause == "body" for case in self._cases)
        self._other = self._other + motion if is_other else 0.0
        is_quiet = float(evidence.ratio.max(initial=0.0)) < LEARNING
        if not self._healthy.is_known or is_quiet or self._other > OTHER:
            self._learn(view, evidence, motion)

    def _compared(self, view: View, before: View | None) -> View:
        """Return a view with newly hidden columns, in which errors are usual that were there before they lied."""
        if before is None or not before.hidden < view.hidden:
            known = self._recent.usual
            self._recent.usual = {columns: usual for columns, usual in known.items() if columns <= view.hidden}
            return view
        began = max((case.began for case in self._cases if case.is_hidden), default=self._count)
        usual = view.usual(self._judge.scale, self._count - began + 1 + EARLIER)
        self._recent.usual[view.hidden] = usual * self._recent.usual.get(view.hidden, 1.0)
        return view.scaled(usual)

    def _decide(self, evidence: Evidence, hidden: Hidden, is_steady: bool) -> None:
        """Suspect, hide and show elements; `is_steady` says whether the same were missing in the block before."""
        immune = [self._place[p] for p in self._immune if p in self._place]
        ratio = self._left(evidence, hidden)
        ratio[list(self._sudden(LATELY))] /= SUSPECT
        stuck = list(self._recent.repeats.stuck - hidden)
        ratio[stuck] = np.maximum(ratio[stuck], 1.0)
        ratio[immune] = 0.0
        highest = float(ratio.max(initial=0.0))
        self._alarmed = self._alarmed + 1 if highest >= 1.0 else 0
        is_due = self._count % AGAIN == 0
        again = highest >= 1.0 and self._count % (AGAIN if self._is_known_body() else RARELY) == 0
        known, is_alarm = self._search.answer(self._cases, ratio, again), highest >= 1.0 and (is_steady or is_due)
        if known is not None:
            known.last, known.moved = self._count, known.moved + self._motion
        elif is_alarm or (highest >= DOUBTFUL and is_due and self._hides_others(ratio, hidden)):
            self._suspect(self._explain(evidence, hidden), evidence, hidden)
        else:
            highest = float(evidence.ratio.max(initial=0.0))
            for case in [c for c in self._cases if not c.is_hidden and self._has_lapsed(c, highest)]:
                self._close(case)
        if is_due:
            for case in [case for case in self._cases if case.is_hidden]:
                self._judge_again(case)
        if immune and is_due and float(evidence.ratio[immune].max()) < CALM:
            self._immune.clear()

    def _conditions(self, hidden: Hidden, age: int) -> Iterator[tuple[str, Evidence, bool]]:
        """Yield each other trained condition, the evidence if it holds since about `age` blocks, and if it is known."""
        schema, alternatives = self._schema, self._alternatives(hidden)
        assert schema is not None
        for name, bias in schema.biases.items():
            if not np.array_equal(bias, schema.bias):
                yield name, alternatives.condition(name, age), not is_another(schema, bias, self._biases).all()

    def _may_be_exchange(self) -> bool:
        """Whether exchanges are looked for in this block: of a new alarm, of one that is one, and now and then."""
        is_one = any(case.cause.is_exchange and not case.is_hidden for case in self._cases)
        return is_one or self._alarmed <= AGAIN or self._count % AGAIN == 0

    def _left(self, evidence: Evidence, hidden: Hidden) -> np.ndarray:
        """Return the evidence, or less if it is less with exchanged elements read in each other's place, shape (n,)."""
        ratio = evidence.ratio.copy()
        for case in self._cases:
            if case.is_hidden and case.cause.is_exchange and ratio.max() >= DOUBTFUL:
                ratio = np.minimum(ratio, self._rest(case, hidden - case.cause.columns).ratio)
        return ratio

    def _rest(self, case: Case, hidden: Hidden) -> Evidence:
        """Return the evidence without the elements of a case, or with exchanged ones in each other's place."""
        if case.cause.is_exchange:
            return self._alternatives(hidden).exchanged(case.cause.columns, self._count - case.began + 1)
        return self._without(hidden, self._count - case.began + 1)(case.cause.columns)

    def _alternatives(self, hidden: Hidden) -> Alternatives:
        assert self._schema is not None and self._relations is not None
        return Alternatives(self._schema, self._relations, self._recent, self._judge, hidden)

    def _suspect(self, cause: Cause, evidence: Evidence, hidden: Hidden) -> None:
        """Suspect a cause, or hide it if it has been suspected before."""
        known = next((case for case in self._cases if not case.is_hidden and case.cause.cause == cause.cause), None)
        if known is not None and known.cause.columns == cause.columns:
            known.seen, known.last = known.seen + 1, self._count
            known.moved += self._motion
        else:
            self._cases = [case for case in self._cases if case.is_hidden]
            began = self._count - int(evidence.age[cause.lead]) + 1
            known = Case(cause, began, self._count, self._count)
            self._cases.append(known)
        known.weigh(evidence, self._sudden(LATELY), self._recent.repeats.stuck, self._parts)
        is_enough = known.is_plain or known.weight >= self._healthy.caution or cause.cause == "environment"
        self._describe(known, hidden | cause.columns, bool(evidence.is_noise[cause.lead]))
        if cause.cause == "body" and known.seen >= UNEXPLAINED:
            self._release_recent()
        if known.seen >= CONFIRMED and is_enough and cause.cause != "body":
            known.reason = self._refusal(known, float(evidence.ratio.max()))
            known.is_hidden = not known.reason
            self._limit_at_once(known)

    def _release_recent(self) -> None:
        """Show elements again that were hidden a short time ago, because they do not explain what is seen."""
        recent = [case for case in self._cases if case.is_hidden and self._count - case.first < ONCE_MORE]
        for case in recent:
            if case.cause.cause != "environment":
                self._cases.remove(case)
                self._immune.update(self._at(case))

    def _has_lapsed(self, case: Case, highest: float) -> bool:
        """Whether nothing speaks for a suspicion any more; `highest` is the evidence against any element."""
        if highest >= 1.0 and case.cause.cause == "body":
            case.last = self._count
        return self._count - case.last > LAPSES

    def _hides_others(self, ratio: np.ndarray, hidden: Hidden) -> bool:
        """Whether one of the columns with the most evidence hides another one that is wrong too."""
        without, least = self._without(hidden), AMONG * float(ratio.max())
        order = [int(column) for column in np.argsort(-ratio)[:SEARCHED] if ratio[column] >= least]
        alone = (float(without(frozenset({column})).ratio.max()) for column in order)
        return any(highest >= PLAIN for highest in alone)

    def _limit_at_once(self, new: Case) -> None:
        """Take a change of many elements at once as one of the body, which hides none of them."""
        together = [c for c in self._cases if c.is_hidden and abs(c.began - new.began) < ONCE and self._at(c)]
        elements = frozenset().union(*(self._at(case) for case in together))
        if len(elements) <= AT_ONCE or any(elements <= device for device in self._devices):
            return
        self._cases = [case for case in self._cases if case not in together]
        body = Cause(frozenset(), "body", new.cause.lead)
        self._cases.append(Case(body, min(case.began for case in together), self._count, self._count))
        self._immune.update(elements)

    def _refusal(self, case: Case, ratio: float) -> str:
        """Return why a cause is not hidden; empty if it is. `ratio` is the evidence, as a multiple of an alarm."""
        if case.cause.cause == "environment":
            return ""
        if case.cause.cause == "either" and self._config.pairs == "use":
            return "they look alike, and the settings say to use them"
        elements = self._at(case)
        rest = self._rest(case, self._hidden_columns() | self._recent.missing())
        case.is_gross = ratio >= GROSS and rest.level < LIKE
        is_sure = case.is_gross and (case.moved >= LONG or case.jumped_alone)
        if rest.level > STRANGE or not (self._is_known_body(case.cause.columns) or is_sure):
            return "what is normal is not known on this body"
        if self._immune & elements:
            return "it is not hidden again before it has agreed once"
        return "" if self._replaces(self.hidden | elements) else "the model cannot replace it"

    def _judge_again(self, case: Case) -> None:
        """Let a hidden cause return if it agrees, and correct it while that is possible."""
        assert self._relations is not None and self._schema is not None
        rest = (self._hidden_columns() - case.cause.columns) | self._recent.missing()
        shown = self._recent.view(self._relations, rest)
        if self._recent.resting <= self._count - case.first:  # it lied already when the body settled
            shown = replace(shown, settled=np.full_like(shown.settled, np.nan))
        evidence = self._judge(shown)
        if self._count - case.first > AGAIN + LATELY and case.cause.columns & self._sudden(AGAIN):
            case.has_jumped = False
        columns = sorted(case.cause.columns - self._recent.missing())
        if not columns:
            return
        if float(evidence.ratio.max(initial=0.0)) < CALM:
            errors = np.abs(shown.z[:, columns] / self._judge.scale[columns])
            is_silent = errors.max() < self._judge.least[columns].max()
            if case.cause.is_exchange and self._count - case.first < LONGEST:
                return  # where the two cross they seem to agree
            if case.cause.columns & self._recent.repeats.stuck:
                return  # it agrees by chance
            if case.has_jumped and self._count - case.first < PATIENCE:
                return  # it jumped away, and has not jumped back
            if self._recent.jumps.is_restless(case.cause.columns, shown.healthy[-1] * self._judge.scale):
                return
            if is_silent and np.isfinite(shown.z[:, columns]).all() and has_moved(case, shown, self._recent):
                self._close(case)
            return
        if self._count - case.first > SETTLED or case.cause.cause == "environment":
            return
        self._describe(case, self._hidden_columns())
        if case.cause.cause not in ("element", "either"):
            return
        again = self._explain(evidence, rest, is_new=False)
        if again.cause == "part" and case.cause.columns < again.columns:
            case.cause, case.may_be_body = again, True
        elif again.cause == "element" and not again.columns & self._environment:
            beyond = self._relations.beyond(self._schema, self._recent.values()[-1])
            if case.yields_to(again, evidence, self._parts, beyond):
                case.cause = again
                self._describe(case, rest | again.columns)

    def _close(self, case: Case) -> None:
        """End a case; one without a plain lie may have been a contact, and such errors are usual from now on."""
        self._cases.remove(case)
        if case.cause.cause in ("element", "either", "all", "part") and not case.is_plain:
            self._healthy.excuse(sorted(case.cause.columns), case.steps, case.is_hidden)

    def _describe(self, case: Case, hidden: Hidden, is_noise: bool = False) -> None:
        """Find kind and size of a lie from its blocks so far, predicted from trusted elements only."""
        assert self._relations is not None and self._schema is not None
        view, scale = self._recent.view(self._relations, hidden | case.cause.columns), self._judge.scale
        is_noise |= case.kind == "noise" or self._recent.jumps.is_restless(case.cause.columns, view.healthy[-1] * scale)
        describe(case, view, self._recent, self._relations, self._schema, scale, self._count, is_noise)

    def _learn(self, view: View, evidence: Evidence, motion: float) -> None:
        noise, z = view.noises[-1].copy(), view.z.copy()
        z[:, list(view.hidden)], noise[list(view.hidden)] = np.nan, np.nan
        self._recent.jumps.learn(view.hidden)
        if np.isfinite(z[-1]).any():
            self._healthy.add(z, evidence.step, noise, motion)

    def _fresh_judge(self) -> Judge:
        return Judge(self._healthy, self._config.false_alarms, self._least)

    def _explain(self, evidence: Evidence, hidden: Hidden, is_new: bool = True) -> Cause:
        """Return the most likely cause of an alarm; of one that is not new, without other tools and exchanges."""
        assert self._relations is not None and self._schema is not None
        age = int(evidence.age.flat[evidence.strength.argmax()])
        parts, begun = remaining(self._parts, hidden, self._hidden_by_cases() & hidden)
        return explain(
            evidence, self._without(hidden, age), self._joined, parts,
            self._environment - hidden if is_new else frozenset(),
            lambda: self._conditions(hidden, age),
            self._alternatives(hidden).exchanges(evidence) if is_new and self._may_be_exchange() else (),
            self._relations.beyond(self._schema, self._recent.values()[-1]),
            (self._sudden(age) | self._recent.repeats.stuck) - hidden,
            begun,
        )  # fmt: skip

    def _sudden(self, age: int) -> Hidden:
        """Return the columns that jumped within about the newest `age` blocks while all others moved as usual."""
        assert self._view is not None
        return self._recent.jumps.sudden(age, self._view.healthy[-1] * self._judge.scale)

    def _without(self, hidden: Hidden, age: int = LONGEST) -> Callable[[Hidden], Evidence]:
        """Return the evidence with more columns hidden; errors are usual that were there before `age` blocks."""
        relations, judge = self._relations, self._judge
        assert relations is not None

        def without(more: Hidden) -> Evidence:
            view = self._recent.view(relations, hidden | more)
            return judge(view.scaled(view.usual(judge.scale, age + EARLIER)))

        return without

    def _hidden_columns(self) -> Hidden:
        by_hand = {self._place[p] for p in self._by_hand if p in self._place}
        return self._hidden_by_cases() | by_hand

    def _hidden_by_cases(self) -> Hidden:
        return frozenset().union(*(case.cause.columns for case in self._cases if case.is_hidden))

    def _at(self, case: Case) -> frozenset[int]:
        """Return the positions in the layout of a case's elements, without p."""
        assert self._relations is not None
        columns = [c for c in case.cause.columns if c < self._relations.count]
        return frozenset(int(self._relations.columns[c]) for c in columns)

    def _finding(self, case: Case) -> Finding:
        at = sorted(self._at(case), key=lambda p: (self._place[p] != case.cause.lead, p))
        return case.finding(at, since=self._now - (self._count - case.began) * BLOCK)
