"""After one sensor was hidden: a second one needs more evidence, and the first may have been another one."""

from dataclasses import replace

import numpy as np
import pytest
from test_trust_jumps import SIZE, evidence
from test_trust_proposed import moved
from test_trust_tools import CHANGE, LAYOUT, SAMPLES, TOOLS, body, model, walk

from gemuco.trust.cases import Case
from gemuco.trust.changes import LONGEST
from gemuco.trust.config import BLOCK
from gemuco.trust.hypotheses import CANDIDATES, Cause, explain
from gemuco.trust.monitor import BESIDE, TrustMonitor

__all__ = ["model"]
SHOULDER, ELBOW, GRAVITY = 0, 1, 2


def blocks_of(model, rows):
    """Return samples in blocks [standard deviations], shape (blocks, SAMPLES, elements)."""
    return model.scaler.normalise(rows).reshape(-1, SAMPLES, LAYOUT.size)


def hide(monitor, element, **how):
    """Let a monitor hide an element now."""
    column = monitor._bench.place[element]
    cause = Cause(frozenset({column}), "element", column)
    monitor._cases.append(Case(cause, monitor._count, monitor._count, monitor._count, is_hidden=True, **how))


def alarming(monitor, column, ratio):
    """Let each look of a monitor give this evidence [multiples of an alarm] against a column; it explains it alone."""
    bench = monitor._bench

    def look(hidden, motion, since):
        view = bench.view = bench.shown(hidden)
        known, found = bench.judge(view), np.zeros(len(bench.relations.columns))
        found[column] = ratio * (column not in hidden)
        return replace(known, ratio=found, strength=20.0 * found)

    bench.look = look
    bench.conditions = lambda hidden, age: ()
    bench.without = lambda hidden, age=0: lambda more: look(hidden | more, 0.0, 0)


@pytest.fixture
def watched(model):
    """Return a monitor of a body with a tool that it has known for long, and the next samples in blocks."""
    monitor, blocks = TrustMonitor(model), blocks_of(model, body(walk(CHANGE + 12, 70), TOOLS["short"]))
    for number, block in enumerate(blocks[:CHANGE]):
        monitor.add(block, number * BLOCK)
    assert not monitor.findings
    return monitor, blocks[CHANGE:]


@pytest.mark.parametrize(("is_first", "ratio"), [(True, 1.5), (False, 1.5), (False, 1.1 * BESIDE)])
def test_while_an_element_is_hidden_a_mild_contradiction_hides_no_other(watched, is_first, ratio, monkeypatch):
    monitor, blocks = watched
    if not is_first:
        hide(monitor, SHOULDER, is_plain=True)
    monkeypatch.setattr(monitor, "_judge_again", lambda case: None)
    alarming(monitor, monitor._bench.place[GRAVITY], ratio)
    for number, block in enumerate(blocks, CHANGE):
        monitor.add(block, number * BLOCK)
    assert (GRAVITY in monitor.hidden) == (is_first or ratio > BESIDE)


@pytest.mark.parametrize(("ratio", "is_followed"), [(0.5, True), (1.2, True), (2.0, False)])
def test_p_of_the_same_tool_is_not_followed_in_an_alarm(watched, model, ratio, is_followed):
    monitor, blocks = watched
    alarming(monitor, monitor._bench.place[GRAVITY], ratio)
    near = moved(model, 0.05)
    monitor.use(near)
    monitor.add(blocks[0], CHANGE * BLOCK)
    assert (monitor._tool.schema is near) == is_followed


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.long) for seed in (1, 2, 3))])
def test_a_wrong_suspect_is_shown_again_and_the_right_one_hidden(model, seed):
    rows, monitor = body(walk(CHANGE + 30, 80 + seed), TOOLS["short"]), TrustMonitor(model)
    rows[CHANGE * SAMPLES :, SHOULDER] += 0.4
    for number, block in enumerate(blocks_of(model, rows)):
        if number == CHANGE:
            hide(monitor, GRAVITY)
        monitor.add(block, number * BLOCK)
    assert SHOULDER in monitor.hidden
    assert GRAVITY not in monitor.hidden


@pytest.mark.parametrize(("every", "returns"), [(1000, True), (8, True), (2, False)])
def test_an_element_that_agrees_returns_though_samples_are_missing_now_and_then(model, every, returns):
    """A stall of the machine leaves a block without samples; if every other one is, too little is known."""
    rows, monitor = body(walk(CHANGE + 60, 90), TOOLS["short"]), TrustMonitor(model)
    for number, block in enumerate(blocks_of(model, rows)):
        if number == CHANGE:
            hide(monitor, SHOULDER, kind="frozen")
        if number >= CHANGE - LONGEST and number % every == 0:
            block[:] = np.nan
        monitor.add(block, number * BLOCK)
    assert (SHOULDER not in monitor.hidden) == returns


@pytest.mark.parametrize("rule", ["trusted by hand", "not replaced", "body", "a part that changed"])
def test_a_case_is_not_given_to_an_element_that_must_not_be_hidden(model, rule, monkeypatch):
    replaced = {GRAVITY} if rule == "not replaced" else set(range(LAYOUT.size))
    monitor = TrustMonitor(model, replaces=lambda elements: elements <= replaced)
    rows = body(walk(CHANGE + 2, 80), TOOLS["short"])
    for number, block in enumerate(blocks_of(model, rows)):
        monitor.add(block, number * BLOCK)
    hide(monitor, GRAVITY, may_be_body=rule == "a part that changed")
    bench = monitor._bench
    monkeypatch.setattr(monitor, "_describe", lambda *_: None)
    if rule == "trusted by hand":
        monitor._immune = {SHOULDER}
    columns = bench.environment if rule == "body" else frozenset({bench.place[SHOULDER]})
    cause = Cause(columns, "element", min(columns))
    monkeypatch.setattr(monitor, "_explain", lambda evidence, hidden, is_new=True: cause)
    evidence = bench.judge(bench.shown(frozenset()))
    strength = np.zeros(len(evidence.strength))
    strength[min(columns)] = 50.0
    monkeypatch.setattr(bench, "judge", lambda view: replace(evidence, strength=strength))
    assert not monitor._reconsider(monitor._hidden_columns())
    assert monitor.hidden == {GRAVITY}
    monitor._immune, replaced, monitor._cases[0].may_be_body = set(), set(range(LAYOUT.size)), False
    assert monitor._reconsider(monitor._hidden_columns()) == (rule != "body")


def test_few_that_jumped_and_contradict_less_than_another_only_began_to_move(model, monkeypatch):
    monitor = TrustMonitor(model)
    for number, block in enumerate(blocks_of(model, body(walk(CHANGE, 71), TOOLS["short"]))):
        monitor.add(block, number * BLOCK)
    bench, jumped = monitor._bench, frozenset({SHOULDER})
    monkeypatch.setattr(bench, "jumped", lambda age: jumped)
    known = bench.judge(bench.shown(frozenset()))
    ratio = np.zeros(len(known.ratio))
    ratio[[SHOULDER, ELBOW]] = 1.2, 1.3
    assert bench.began_with(replace(known, ratio=ratio)) == jumped
    ratio[ELBOW] = 2.0
    assert not bench.began_with(replace(known, ratio=ratio))
    jumped |= {3, 4, 5}
    assert bench.began_with(replace(known, ratio=ratio)) == jumped, "of many it is the tool"


def test_one_with_less_evidence_than_others_is_blamed_if_it_alone_explains_all() -> None:
    alarm = evidence(*range(SIZE))
    size = CANDIDATES + 2
    ratio = np.linspace(3.0, 2.0, size)
    alarm = replace(
        alarm, **{name: np.resize(getattr(alarm, name), size) for name in ("age", "step", "is_noise", "is_slow")}
    )
    alarm, last = replace(alarm, ratio=ratio, strength=10.0 * ratio), size - 1
    calm = replace(alarm, ratio=np.zeros(size), strength=np.zeros(size))
    cause = explain(alarm, lambda hidden: calm if last in hidden else alarm, (), (), frozenset())
    assert (cause.cause, cause.columns) == ("element", {last})
