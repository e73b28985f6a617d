"""Snapshots as HTML; all text that came over the network is escaped."""

import math
import time
from collections.abc import Iterator, Sequence
from html import escape

from services.view.bias_map import BiasMap
from services.view.controls import Outcome
from services.view.styles import STYLE, numbers, page, table
from services.view.taught import TaughtFile
from services.watch.service_rows import Level, ServiceRow
from services.watch.signal_rows import Kind, SignalRow
from services.watch.snapshot import RobotSnapshot
from services.watch.trouble import HEALTHY, Trouble, verdict
from services.wire.messages import Update

SYMBOLS = {Kind.MEASURED: "●", Kind.ESTIMATED: "◆", Kind.MASKED: "○", Kind.OLD: "◌"}
DECIMALS = {"rad": 3, "rad/s": 3, "m": 4, "N": 1, "N m": 2, "px": 0, "kg": 3, "degC": 1}
LEVELS = {
    Level.GOOD: ("ok", "✓"), Level.NOTE: ("note", "i"), Level.DEGRADED: ("warn", "!"), Level.ANOMALY: ("bad", "✕"),
    Level.TROUBLE: ("bad", "✕"), Level.GONE: ("gone", "◌"),
}  # fmt: skip
ALSO = 3
"""At most this number of other troubles is shown below the worst one."""
TONES = {Level.GOOD: ("good", "●"), Level.DEGRADED: ("poor", "◆"), Level.TROUBLE: ("lost", "✕")}


def number(value: float, unit: str) -> str:
    """Return a value with the decimals of its unit; a dash for NaN."""
    return f"{value:.{DECIMALS.get(unit, 3)}f}" if math.isfinite(value) else "–"


def age(seconds: float) -> str:
    """Return an age in ms, s or min, at most seven characters."""
    if not math.isfinite(seconds):
        return "–"
    if seconds < 1.0:
        return f"{1e3 * seconds:.0f} ms"
    if seconds < 100.0:
        return f"{seconds:.1f} s"
    return f"{seconds / 60.0:.0f} min" if seconds < 6000.0 else "> 1 h"


def banner_html(troubles: Sequence[Trouble]) -> str:
    """Return the worst trouble, and the next ones below it."""
    worst, *others = troubles or [HEALTHY]
    kind, symbol = LEVELS[worst.level]
    also = "".join(f'<div class="also">{escape(str(trouble))}</div>' for trouble in others[:ALSO])
    title = f"<b><i>{symbol}</i>{escape(worst.title)}</b>"
    return STYLE + page(f'<div class="b {kind}">{title}{escape(worst.text)}{also}</div>')


def facts_html(snapshot: RobotSnapshot, source: str, read_only: str, last: Outcome | None) -> str:
    """Return the mode of the motors, the lease holder, the source of the data and the last request."""
    mode = snapshot.motors
    tone = {"follow": "good", "hold": "good", "off": "dim", "": "dim", "fault": "lost"}.get(mode, "poor")
    lines = [("motors", tone, mode or "not known"), ("lease", "", snapshot.lease_holder), ("source", "", source)]
    if read_only:
        lines.append(("buttons", "dim", read_only))
    elif last is None:
        lines.append(("request", "dim", "none yet"))
    else:
        when = time.strftime("%H:%M:%S", time.localtime(last.at))
        lines.append(("request", "good" if last.is_done else "lost", f"{when} {last.text}"))
    wraps = ' style="white-space:normal"'
    cells = (
        f'<span>{name}</span><span title="{escape(text)}"{wraps if name in ("request", "buttons") else ""}>'
        f'<span class="{tone}">{escape(text)}</span></span>'
        for name, tone, text in lines
    )
    return page(f'<div class="facts">{"".join(cells)}</div>')


def legend_html(has_wires: bool) -> str:
    """Return the meaning of the colors in 3D."""
    colors = {
        "#5ca0e6": "measured",
        "#ffb04c": "estimated",
        "#6d7583": "not known",
        "#ffffff55": "what the sensor says",
    }
    parts = [f'<span><span style="color:{color}">■</span> {text}</span>' for color, text in colors.items()]
    if has_wires:
        parts.append(
            "<span>wires: slack "
            '<span style="background:linear-gradient(90deg,#1446e6,#ffa000,#ff1400);padding:0 22px"></span>'
            " limit</span>"
        )
    return page(f'<div class="legend">{"".join(parts)}</div>')


def signals_html(rows: Sequence[SignalRow]) -> str:
    """Return the table of all elements of all signals."""
    lines = list(_signal_lines(rows)) or ['<tr><td colspan="5" class="dim">No signal has arrived yet.</td></tr>']
    return page(table((31, 23, 17, 14, 15), ("element", "", ">value", ">± std", ">age"), lines))


def _signal_lines(rows: Sequence[SignalRow]) -> Iterator[str]:
    for signal in dict.fromkeys(row.signal for row in rows):
        own = [row for row in rows if row.signal == signal]
        origin = next((row for row in own if row.source), None)
        recipe = ""
        if origin is not None:
            method = f" ({origin.method})" if origin.method not in ("", "mask") else ""
            recipe = escape(f" estimated from {origin.source}{method}")
        bad = next((row for row in own if row.state in ("doubtful", "unknown")), None)
        if bad is not None:
            tone = "lost" if bad.state == "unknown" else "poor"
            recipe += f' <span class="{tone}" title="{escape(bad.reason)}">{escape(bad.state)}</span>'
        unit = f"<small>[{escape(own[0].unit)}]</small>"
        title = f'{escape(signal)} {unit}<small class="k-estimated">{recipe}</small>'
        yield f'<tr class="s"><th colspan="5">{title}</th></tr>'
        for row in own:
            word = f'<span class="k-{row.kind}">{SYMBOLS[row.kind]} {row.kind}</span>'
            word += f'<div class="also">{escape(row.distrust)}</div>' if row.distrust else ""
            std = number(row.std, row.unit) if row.kind is Kind.ESTIMATED else ""
            yield (
                f'<tr class="k-{row.kind}"><td>{escape(row.element)}</td><td>{word}</td>'
                f'<td class="n v">{number(row.value, row.unit)}</td>{numbers(std, f"~{age(row.age)}")}</tr>'
            )


def services_html(services: Sequence[ServiceRow]) -> str:
    """Return the table of services and the timing of their loops."""
    heads = ("loop", ">want Hz", ">Hz", ">p99 ms", ">max ms", ">skips")
    lines = (line for service in services for line in _service_lines(service))
    return page(table((28, 15, 15, 14, 15, 13), heads, lines))


def _service_lines(service: ServiceRow) -> Iterator[str]:
    tone, symbol = TONES[service.level]
    since = "" if service.is_present or not math.isfinite(service.age) else f" heard {age(service.age)} ago"
    yield (
        f'<tr class="s"><th colspan="6">{escape(service.name)} '
        f'<span class="{tone}">{symbol} {escape(service.state)}</span><small>{since}</small></th></tr>'
    )
    for loop in service.loops:
        slow, late = ("!" if service.is_present and fault else "" for fault in (loop.is_slow, loop.is_late))
        p99, worst = f"{1e3 * loop.p99:.2f}", f"{late}{1e3 * loop.worst:.2f}"
        cells = numbers(f"~{loop.wanted:.0f}", f"{slow}{loop.rate:.1f}", p99, worst, f"{loop.skipped:.0f}")
        yield f'<tr class="{"" if service.is_present else "k-old"}"><td>{escape(loop.name)}</td>{cells}</tr>'
    if service.text:
        yield f'<tr><td colspan="6" class="dim" style="white-space:normal">{escape(service.text)}</td></tr>'


def anomaly_html(snapshot: RobotSnapshot) -> str:
    """Return the anomaly score, the verdict and the blamed element."""
    judged = verdict(snapshot)
    if judged is None or not math.isfinite(judged.score):
        text = "Not judged: no score arrives, or the model has no normal data."
        return page(f'<div style="min-height:30px" class="dim">{text}</div>')
    kind = {"anomaly": "lost", "environment": "poor", "unknown": "dim", "outside": "dim"}.get(judged.kind, "good")
    words = {
        "": "nothing to judge",
        "environment": "environment changed",
        "unknown": "normal not known on this body",
        "outside": "outside of what was learned",
    }
    word = words.get(judged.kind, judged.kind)
    blamed = f"most likely wrong: {judged.blamed or 'not known yet'}" if judged.is_anomaly else ""
    score = f'score <b>{judged.score:.1f}</b> <span class="dim">threshold</span> {judged.threshold:.1f}'
    return page(
        f'<div style="display:flex;justify-content:space-between"><span>{score}</span>'
        f'<span class="{kind}">{escape(word)}</span></div>'
        f'<div class="dim" style="min-height:15px">{escape(blamed)}</div>'
    )


def bias_html(bias_map: BiasMap | None, picture: str, update: Update | None) -> str:
    """Return the picture of the bias map, and the state of the online update."""
    facts = '<span class="dim">update</span> not known'
    if update is not None:
        state = "resting" if not update.active else "learning" if update.settled else "recognising"
        loss = f", loss {update.loss:.4f}" if math.isfinite(update.loss) else ""
        facts = f'<span class="dim">update</span> {state}, model {update.model_version}, window {update.window}{loss}'
        facts += f", W rolled back {update.rolled_back} times" if update.rolled_back else ""
    if bias_map is None:
        text = "This model knows one body only: no condition has a p of its own."
        return page(f'<div>{facts}</div><div class="dim" style="margin-top:8px">{text}</div>')
    near = "p is not known yet"
    if bias_map.nearest:
        near = f"nearest condition: <b>{escape(bias_map.nearest)}</b>"
        near += f' <span class="dim">at {bias_map.distance:.0%} of the spread</span>'
    legend = "▫ trained condition   ⊕ p now, and its past"
    return page(f'{picture}<div class="dim" style="white-space:pre">{legend}</div><div>{near}</div><div>{facts}</div>')


def teach_html(is_taught: bool, is_moving: bool, message: str, file: TaughtFile) -> str:
    """Return the state of teaching, the last message and the file of the samples."""
    state = '<span class="dim">○ not taken over</span>'
    if is_taught:
        state = '<span class="poor">◆ moving</span>' if is_moving else '<span class="good">● holding</span>'
    text = f'<div style="min-height:30px;white-space:normal">{escape(message)}</div>'
    where = f'<div class="dim">{file.recorded} recorded here, in {escape(str(file.path))}</div>'
    return page(f"<div><b>{state}</b></div>{text}{where}")
