"""The monitor: it judges every element block by block, and hides those that lie until they have agreed again."""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from gemuco.anomaly.blame import parts
from gemuco.schema import BodySchema
from gemuco.trust.bench import DOUBTFUL, LATELY, Bench
from gemuco.trust.cases import Case, LastSearch, describe, has_agreed, has_moved
from gemuco.trust.config import BLOCK, Finding, Hidden, Replaces, TrustConfig
from gemuco.trust.evidence import Evidence
from gemuco.trust.hypotheses import RIVALS, Cause, Signs, explain, remaining
from gemuco.trust.jumps import TOGETHER
from gemuco.trust.relations import Relations
from gemuco.trust.tool import JudgedTool

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
UNEXPLAINED, ONCE_MORE = 3, 100
"""If this number of searches found no cause, those hidden in this number of blocks were no cause either."""
GROSS, LONG, LIKE = 3.0, 50.0, 1.3
"""On a body that is not known to be as the model says, a lie is hidden if it is the first multiple of an alarm, is a
jump or explains the second number of blocks of motion, and leaves errors below the third multiple of those learned."""
FITS = 0.1
"""Errors below this share of those with the lie count as no more than healthy ones."""
HELD = 1.5
"""From this multiple of an alarm on, p of the same tool is not followed: it would explain a growing lie step by step.
But it is at once while the tool is new, or if many elements jumped, as they do when it slips."""
BETTER = 0.5
"""Where no sensor explains the evidence, a p that leaves less than this share of it is judged by."""
MOVED = 30.0
"""A body is not known before it has moved for this number of blocks, with this tool: at rest it shows one posture."""
AT_ONCE, ONCE = 3, 15
"""At most this number of elements are wrong at once, which is within this number of blocks; otherwise the body is."""
SUSPECT = 0.6
"""Of an element that jumped lately, this share of an alarm is one: with limits for one wrong verdict a week, so much
less evidence is enough if a jump of a right element comes once in 20 minutes at most."""
BESIDE = 2.0
"""While an element is hidden, less is known of what is healthy: an alarm needs this multiple of the evidence."""
ACQUAINTED = 60.0
"""A body on which nothing was contradicted for this number of blocks of motion is known, whatever its scores are."""


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
        self._count, self._now = 0, 0.0
        self._by_hand: dict[int, float] = {}
        self._immune: set[int] = set()
        self._cases: list[Case] = []
        self._begin(schema)

    def use(self, schema: BodySchema) -> None:
        """Judge by another model; what is known of the body is kept unless the normal errors were learned anew."""
        if self._tool.schema.normal is schema.normal:
            self._tool.propose(schema)
        else:
            self._begin(schema)

    def _begin(self, schema: BodySchema) -> None:
        relations, self._tool = Relations.of(schema), JudgedTool(schema)
        self._known = bench = None if relations is None else Bench(self._tool, relations, self._config)
        if relations is None or bench is None:
            return
        self._other = self._motion = self._alarmed = 0.0
        self._search, self._missing = LastSearch(), Hidden()
        self._jumped: Hidden | None = None
        """The columns that jumped when the alarm that lasts began, and since, if any did; None without an alarm."""
        self._first: Hidden = frozenset()
        """Those of them that jumped alone in its first block."""
        place, movable = bench.place, [int(p) for p in relations.columns[: relations.count]]
        self._parts = [frozenset(place[p] for p in part) for part in parts(schema, movable)]
        self._joined = [frozenset(place[p] for p in device if p in place) for device in self._devices]

    @property
    def _bench(self) -> Bench:
        """Blocks, limits and tests of a model whose normal errors are known; without them there are no cases either."""
        assert self._known is not None
        return self._known

    @property
    def hidden(self) -> frozenset[int]:
        """Positions in the layout that must not be used as measured."""
        return frozenset(self._by_hand) | frozenset(p for case in self._cases if case.is_hidden for p in self._at(case))

    @property
    def is_ready(self) -> bool:
        """Whether lies can be noticed: what is normal is known, and enough blocks were seen."""
        return self._known is not None and self._known.healthy.is_known

    def _is_known_body(self, columns: Hidden = frozenset()) -> bool:
        """Whether what is healthy is known of this body, with this tool, in motion; of some columns, or of all."""
        bench = self._bench
        if any(case.is_hidden and case.changes(columns, self._parts) for case in self._cases):
            return False
        has_moved = bench.tool.seen_for(bench.healthy.moved) >= MOVED
        return (self.is_known or bench.tool.calm >= ACQUAINTED) and has_moved and bench.is_known_tool

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
        for case in [case for case in self._cases if position in self._at(case)]:
            self._cases.remove(case)
            self._immune.update(self._at(case))

    def add(self, samples: np.ndarray, now: float) -> None:
        """Judge one block.

        Args:
            samples: All samples of the last `BLOCK` seconds [standard deviations], hidden elements included, shape
                (n, size); NaN where not measured.
            now: Time of the last sample [s].
        """
        if self._known is None or not len(samples):
            return
        bench = self._known
        bench.recent.add(bench.schema, bench.relations, samples, now - self._now)
        self._count, self._now = self._count + 1, now
        motion = self._motion = bench.healthy.motion(bench.recent.moved())
        bench.recent.rest(motion, bench.healthy.looks)
        is_steady, self._missing = self._missing == bench.recent.missing(), bench.recent.missing()
        hidden = self._hidden_columns() | self._missing
        if self._count % REFRESH == 0:
            bench.refresh()
        bench.lied_when_settled = any(c.is_young(self._count, bench.recent.resting) for c in self._cases)
        began = max((case.began for case in self._cases if case.is_hidden), default=self._count)
        evidence = bench.look(hidden, motion, self._count - began + 1)
        if bench.healthy.is_known:
            self._decide(evidence, hidden, is_steady)
        self._other = self._other + motion if any(c.cause.cause == "body" for c in self._cases) else 0.0
        is_quiet = evidence.highest < LEARNING
        bench.tool.calm += motion * (evidence.highest < CALM and evidence.level < STRANGE and not hidden)
        if not bench.healthy.is_known or is_quiet or self._other > OTHER:
            bench.learn(evidence, motion)
        if bench.tool.proposed is not None and self._believes_tool(evidence, hidden):
            self._jumped = None if bench.tool.is_another else self._jumped
            bench.tool.accept(bench.healthy.moved)

    def _believes_tool(self, evidence: Evidence, hidden: Hidden) -> bool:
        """Whether to judge by the model's own p; if it is another tool's, it needs to explain what is seen."""
        bench = self._bench
        highest, causes = evidence.highest, {case.cause.cause for case in self._cases}
        is_calm = highest < CALM and "environment" not in causes
        has_settled = bench.tool.seen_for(bench.healthy.moved) >= MOVED and len(self._jumped or ()) <= TOGETHER
        is_held = has_settled and highest >= HELD
        if not bench.healthy.is_known or not (bench.tool.is_another or is_held):
            return not any(case.is_gross and not case.is_hidden for case in self._cases)
        if self._count % AGAIN:
            return False  # another reading costs as much as many blocks
        least = highest + RIVALS if is_calm else BETTER * highest if "body" in causes else CALM
        return bench.under_proposed(hidden, evidence) < least

    def _decide(self, evidence: Evidence, hidden: Hidden, is_steady: bool) -> None:
        """Suspect, hide and show elements; `is_steady` says whether the same were missing in the block before."""
        bench = self._bench
        for case in [case for case in self._cases if case.is_hidden]:
            case.moved += self._motion
        immune = [bench.place[p] for p in self._immune if p in bench.place]
        ratio = self._left(evidence, hidden)
        if any(case.is_hidden for case in self._cases):
            ratio /= BESIDE
        ratio[list(bench.sudden(LATELY))] /= SUSPECT
        stuck = list(bench.recent.repeats.stuck - hidden)
        ratio[stuck] = np.maximum(ratio[stuck], 1.0)
        ratio[immune] = 0.0
        highest = float(ratio.max(initial=0.0))
        if highest < CALM and not any(case.cause.cause == "environment" for case in self._cases):
            self._jumped, self._first = None, frozenset()
        elif highest >= 1.0 and self._jumped is None:
            self._jumped = bench.began_with(evidence) - hidden
            self._first = self._jumped & bench.sudden(LATELY)
        elif self._jumped:
            self._jumped |= bench.jumped(1) - hidden  # another lie may begin
        self._alarmed = self._alarmed + 1 if highest >= 1.0 else 0
        is_due = self._count % AGAIN == 0
        again = highest >= 1.0 and self._count % (AGAIN if self._is_known_body() else RARELY) == 0
        if evidence.highest >= 1.0 and (self._alarmed == CONFIRMED or is_due) and self._reconsider(hidden):
            return
        known, is_alarm = self._search.answer(self._cases, ratio, again), highest >= 1.0 and (is_steady or is_due)
        if known is not None:
            known.last, known.moved = self._count, known.moved + self._motion
        elif is_alarm or (highest >= DOUBTFUL and is_due and bench.hides_another(ratio, hidden)):
            self._suspect(self._explain(evidence, hidden), evidence, hidden)
        else:
            for case in [c for c in self._cases if not c.is_hidden and c.has_lapsed(self._count, evidence.highest)]:
                self._close(case)
        if is_due:
            for case in [case for case in self._cases if case.is_hidden]:
                self._judge_again(case)
        if immune and is_due and float(evidence.ratio[immune].max()) < CALM:
            self._immune.clear()

    def _reconsider(self, hidden: Hidden) -> bool:
        """Give a young case to another element if that explains also what contradicts the one so far; say whether."""
        bench = self._bench
        beyond = bench.beyond if self._parts else frozenset()  # a cut wire explains what contradicts others
        for case in [case for case in self._cases if case.is_young(self._count)]:
            columns = case.cause.columns
            evidence = bench.judge(bench.shown(hidden - columns))
            again = self._explain(evidence, hidden - columns, is_new=False)
            is_other = again.is_element and not again.columns <= columns and self._may_take(again, case)
            is_other = is_other and not case.is_bound(again, self._parts, beyond)
            if is_other and evidence.strength[again.lead] > evidence.strength[list(columns)].max():
                case.cause = again
                self._describe(case, hidden - columns | again.columns)
                return True
        return False

    def _may_take(self, cause: Cause, case: Case) -> bool:
        """Whether the elements of a cause may be hidden in place of those of a case."""
        elements, others = self._at(replace(case, cause=cause)), self.hidden - self._at(case)
        is_sensor = not cause.columns & self._bench.environment
        is_used = cause.cause == "either" and self._config.pairs == "use"
        is_possible = is_sensor and not is_used and not self._immune & elements and case.has_shown(cause)
        return is_possible and self._replaces(others | elements)

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
        bench = self._bench
        if case.cause.is_exchange:
            return bench.alternatives(hidden).exchanged(case.cause.columns, self._count - case.began + 1)
        return bench.without(hidden, self._count - case.began + 1)(case.cause.columns)

    def _suspect(self, cause: Cause, evidence: Evidence, hidden: Hidden) -> None:
        """Suspect a cause, or hide it if it has been suspected before."""
        bench = self._bench
        known = next((case for case in self._cases if not case.is_hidden and case.cause.cause == cause.cause), None)
        if known is not None and known.cause.columns == cause.columns:
            known.seen, known.last, known.moved = known.seen + 1, self._count, known.moved + self._motion
        else:
            self._cases = [case for case in self._cases if case.is_hidden]
            began = self._count - int(evidence.age[cause.lead]) + 1
            known = Case(cause, began, self._count, self._count)
            self._cases.append(known)
        known.weigh(evidence, bench.sudden(LATELY) | self._first, bench.recent.repeats.stuck, self._parts)
        has_weight = known.weight >= bench.healthy.caution and known.has_shown(cause)
        is_enough = known.is_plain or has_weight or cause.cause == "environment"
        self._describe(known, hidden | cause.columns, bool(evidence.is_noise[cause.lead]))
        if cause.cause == "body" and known.seen >= UNEXPLAINED:
            self._release_recent()
        if known.seen >= CONFIRMED and is_enough and cause.cause != "body":
            known.reason = self._refusal(known, evidence)
            known.is_hidden = not known.reason
            self._limit_at_once(known)

    def _release_recent(self) -> None:
        """Show elements again that were hidden a short time ago, because they do not explain what is seen."""
        recent = [case for case in self._cases if case.is_hidden and self._count - case.first < ONCE_MORE]
        for case in recent:
            if case.cause.cause != "environment":
                self._cases.remove(case)
                self._immune.update(self._at(case))

    def _limit_at_once(self, new: Case) -> None:
        """Take a change of many elements at once as one of the body, which hides none of them."""
        together = [c for c in self._cases if c.is_hidden and abs(c.began - new.began) < ONCE and self._at(c)]
        elements = frozenset().union(*(self._at(case) for case in together))
        if len(elements) <= AT_ONCE or any(elements <= device for device in self._devices):
            return
        began = min(case.began for case in together)
        self._cases = [case for case in self._cases if case not in together]
        self._cases.append(Case(Cause(frozenset(), "body", new.cause.lead), began, self._count, self._count))
        self._immune.update(elements)

    def _refusal(self, case: Case, evidence: Evidence) -> str:
        """Return why a cause is not hidden; empty if it is."""
        bench = self._bench
        if case.cause.cause == "environment":
            return ""
        if case.cause.cause == "either" and self._config.pairs == "use":
            return "they look alike, and the settings say to use them"
        elements = self._at(case)
        rest = self._rest(case, self._hidden_columns() | bench.recent.missing())
        left = min(rest.level, rest.level / (FITS * evidence.level)) if evidence.level else rest.level
        case.is_gross = evidence.highest >= GROSS and left < LIKE
        is_sure = case.is_gross and (case.moved >= LONG or case.jumped_alone)
        if left > STRANGE or not (self._is_known_body(case.cause.columns) or is_sure):
            return "what is normal is not known on this body"
        if bench.was_outside(self._count - case.began + 1) and not is_sure:
            return "the body was outside of what was learned"
        if self._immune & elements:
            return "it is not hidden again before it has agreed once"
        if case.crosses(self._parts, self._joined, bench.sudden(LATELY) | bench.recent.repeats.stuck):
            return "a part of the body may have changed"
        return "" if self._replaces(self.hidden | elements) else "the model cannot replace it"

    def _judge_again(self, case: Case) -> None:
        """Let a hidden cause return if it agrees, and correct it while that is possible."""
        bench = self._bench
        rest = (self._hidden_columns() - case.cause.columns) | bench.recent.missing()
        shown = bench.shown(rest)
        if bench.recent.resting <= self._count - case.first:  # it lied already when the body settled
            shown = replace(shown, settled=np.full_like(shown.settled, np.nan))
        evidence = bench.judge(shown)
        if self._count - case.first > AGAIN + LATELY and case.cause.columns & bench.sudden(AGAIN):
            case.has_jumped = False
        columns = sorted(case.cause.columns - bench.recent.missing())
        if not columns:
            return
        if evidence.highest < CALM:
            if case.waits(self._count) or case.cause.columns & bench.recent.repeats.stuck:
                return  # it agrees by chance
            if bench.recent.jumps.is_restless(case.cause.columns, shown.healthy[-1] * bench.judge.scale):
                return
            agrees = has_agreed(shown.standard(bench.judge.scale)[:, columns], bench.judge.least[columns])
            if agrees and has_moved(case, shown, bench.recent):
                self._close(case)
            return
        if self._count - case.first > SETTLED:
            return
        if case.cause.cause == "environment":
            self._doubt_tool(case, evidence, rest)
            return
        self._describe(case, self._hidden_columns())
        if not case.cause.is_element:
            return
        again = self._explain(evidence, rest, is_new=False)
        is_possible = again.cause == "element" and self._may_take(again, case)
        if again.cause == "part" and case.cause.columns < again.columns:
            case.cause, case.may_be_body = again, True
        elif is_possible and case.yields_to(again, evidence, self._parts, bench.beyond):
            case.cause = again
            self._describe(case, rest | again.columns)

    def _doubt_tool(self, case: Case, evidence: Evidence, rest: Hidden) -> None:
        """Drop another tool as the cause if no p explains all, and an element does with the p so far."""
        bench = self._bench
        left = bench.judge(bench.shown(rest | bench.environment)).highest
        if bench.tool.proposed is not None and not case.cause.condition:
            left = max(left, bench.under_proposed(rest, evidence))
        if left >= CALM and self._explain(evidence, rest, False).cause == "element":
            self._cases.remove(case)

    def _close(self, case: Case) -> None:
        """End a case; one without a plain lie may have been a contact, and such errors are usual from now on."""
        bench = self._bench
        self._cases.remove(case)
        if case.cause.cause in ("element", "either", "all", "part") and not case.is_plain:
            bench.healthy.excuse(sorted(case.cause.columns), case.steps, case.is_hidden)

    def _describe(self, case: Case, hidden: Hidden, is_noise: bool = False) -> None:
        """Find kind and size of a lie from its blocks so far; of some that look alike the first one lies."""
        bench, columns = self._bench, case.cause.columns
        lying = frozenset({case.cause.lead}) if case.cause.cause == "either" else columns
        view, scale = bench.shown(hidden - columns | lying), bench.judge.scale
        is_noise |= case.kind == "noise" or bench.recent.jumps.is_restless(columns, view.healthy[-1] * scale)
        describe(case, view, bench.recent, bench.relations, bench.schema, scale, self._count, is_noise)

    def _explain(self, evidence: Evidence, hidden: Hidden, is_new: bool = True) -> Cause:
        """Return the most likely cause of an alarm; of one that is not new, without other tools and exchanges."""
        bench, age = self._bench, evidence.newest
        parts, begun = remaining(self._parts, hidden, self._hidden_by_cases() & hidden)
        signs = Signs(
            (bench.sudden(age) | bench.recent.repeats.stuck) - hidden, self._first - hidden,
            self._jumped or frozenset(), bench.recent.repeats.held - hidden, bench.moved_alone(age) - hidden,
            bench.beyond, begun,
        )  # fmt: skip
        return explain(
            evidence, bench.without(hidden, age), self._joined, parts,
            bench.environment - hidden if is_new else frozenset(), signs, lambda: bench.conditions(hidden, age),
            bench.alternatives(hidden).exchanges(evidence) if is_new and self._may_be_exchange() else (),
            lambda first, second: bench.relations.are_twins(first, second, hidden),
        )  # fmt: skip

    def _hidden_columns(self) -> Hidden:
        place = self._bench.place
        return self._hidden_by_cases() | {place[p] for p in self._by_hand if p in place}

    def _hidden_by_cases(self) -> Hidden:
        return frozenset().union(*(case.cause.columns for case in self._cases if case.is_hidden))

    def _at(self, case: Case) -> frozenset[int]:
        """Return the positions in the layout of a case's elements, without p."""
        bench = self._bench
        columns = [c for c in case.cause.columns if c < bench.relations.count]
        return frozenset(int(bench.relations.columns[c]) for c in columns)

    def _finding(self, case: Case) -> Finding:
        bench = self._bench
        at = sorted(self._at(case), key=lambda p: (bench.place[p] != case.cause.lead, p))
        return case.finding(at, self._now - (self._count - case.began) * BLOCK, bench.tool.has_explained)
