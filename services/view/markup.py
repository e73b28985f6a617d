"""What was seen, as HTML; everything that came over the network is escaped."""

import math
import time
from collections.abc import Iterator, Sequence
from html import escape

from services.view.attendance import ServiceRow
from services.view.banner import Banner, Level
from services.view.bias_map import Map
from services.view.controls import Outcome
from services.view.rows import Kind, Row
from services.view.seen import Seen
from services.view.styles import STYLE, numbers, page, table
from services.view.taught import TaughtFile
from services.wire.messages import Update

SYMBOLS = {Kind.MEASURED: "●", Kind.ESTIMATED: "◆", Kind.MASKED: "○", Kind.OLD: "◌"}
DECIMALS = {"rad": 3, "rad/s": 3, "m": 4, "N": 1, "N m": 2, "px": 0, "kg": 3, "degC": 1}
LEVELS = {
    Level.OK: ("ok", "✓"), Level.NOTE: ("note", "i"), Level.WARN: ("warn", "!"), Level.BAD: ("bad", "✕"),
    Level.GONE: ("gone", "◌"),
}  # fmt: skip
ALSO = 3
"""So many other troubles are told below the worst one."""
GOOD, LOST = {"running", "ready"}, {"gone", "fault", "silent"}


def number(value: float, unit: str) -> str:
    """A value with as many decimals as its unit deserves; a dash where there is none."""
    return f"{value:.{DECIMALS.get(unit, 3)}f}" if math.isfinite(value) else "–"


def age(seconds: float) -> str:
    """An age in ms, s or min, never longer than seven characters."""
    if not math.isfinite(seconds):
        return "–"
    if seconds < 1.0:
        return f"{1e3 * seconds:.0f} ms"
    if seconds < 100.0:
        return f"{seconds:.1f} s"
    return f"{seconds / 60.0:.0f} min" if seconds < 6000.0 else "> 1 h"


def banner_html(found: Banner) -> str:
    """The sentence that matters most."""
    kind, symbol = LEVELS[found.level]
    also = "".join(f'<div class="also">{escape(line)}</div>' for line in found.also[:ALSO])
    title = f"<b><i>{symbol}</i>{escape(found.title)}</b>"
    return STYLE + page(f'<div class="b {kind}">{title}{escape(found.text)}{also}</div>')


def facts_html(seen: Seen, source: str, read_only: str, last: Outcome | None) -> str:
    """Who commands, what the motors do, where the data come from, what was last asked."""
    mode = seen.mode
    tone = {"follow": "good", "hold": "good", "off": "dim", "": "dim", "fault": "lost"}.get(mode, "poor")
    lines = [("motors", tone, mode or "not known"), ("command", "", _holder(seen)), ("source", "", source)]
    if read_only:
        lines.append(("buttons", "dim", read_only))
    elif last is None:
        lines.append(("asked", "dim", "nothing yet"))
    else:
        when = time.strftime("%H:%M:%S", time.localtime(last.at))
        lines.append(("asked", "good" if last.is_done else "lost", f"{when} {last.text}"))
    wraps = ' style="white-space:normal"'
    cells = (
        f'<span>{name}</span><span title="{escape(text)}"{wraps if name in ("asked", "buttons") else ""}>'
        f'<span class="{tone}">{escape(text)}</span></span>'
        for name, tone, text in lines
    )
    return page(f'<div class="facts">{"".join(cells)}</div>')


def _holder(seen: Seen) -> str:
    holder = seen.fresh(seen.holder)
    if holder is None:
        return "not told"
    if not holder.holder:
        return "nobody"
    return f"{holder.name or f'client {holder.holder}'}, {holder.left:.0f} s left"


def signals_html(rows: Sequence[Row]) -> str:
    """Every element of every signal."""
    lines = list(_signal_lines(rows)) or ['<tr><td colspan="5" class="dim">No signal was heard of yet.</td></tr>']
    return page(table((31, 23, 17, 14, 15), ("element", "", ">value", ">± std", ">age"), lines))


def _signal_lines(rows: Sequence[Row]) -> Iterator[str]:
    for signal in dict.fromkeys(row.signal for row in rows):
        own = [row for row in rows if row.signal == signal]
        origin = next((row for row in own if row.source), None)
        told = ""
        if origin is not None:
            method = f" ({origin.method})" if origin.method not in ("", "mask") else ""
            told = escape(f" estimated from {origin.source}{method}")
        unit = f"<small>[{escape(own[0].unit)}]</small>"
        yield (
            f'<tr class="s"><th colspan="5">{escape(signal)} {unit}<small class="k-estimated">{told}</small></th></tr>'
        )
        for row in own:
            word = f'<span class="k-{row.kind}">{SYMBOLS[row.kind]} {row.kind}</span>'
            std = number(row.std, row.unit) if row.kind is Kind.ESTIMATED else ""
            yield (
                f'<tr class="k-{row.kind}"><td>{escape(row.element)}</td><td>{word}</td>'
                f'<td class="n v">{number(row.value, row.unit)}</td>{numbers(std, f"~{age(row.age)}")}</tr>'
            )


def services_html(services: Sequence[ServiceRow]) -> str:
    """Who is there, and how the loops keep time."""
    heads = ("loop", ">want Hz", ">Hz", ">p99 ms", ">max ms", ">skips")
    lines = (line for service in services for line in _service_lines(service))
    return page(table((28, 15, 15, 14, 15, 13), heads, lines))


def _service_lines(service: ServiceRow) -> Iterator[str]:
    tone = "good" if service.state in GOOD else "lost" if service.state in LOST else "dim"
    tone = "poor" if tone == "dim" and service.state != "absent" else tone
    symbol = {"good": "●", "lost": "✕", "dim": "○", "poor": "◆"}[tone]
    since = "" if service.is_there or not math.isfinite(service.age) else f" heard {age(service.age)} ago"
    yield (
        f'<tr class="s"><th colspan="6">{escape(service.name)} '
        f'<span class="{tone}">{symbol} {escape(service.state)}</span><small>{since}</small></th></tr>'
    )
    for loop in service.loops:
        is_slow = loop.rate + 1.0 < 0.95 * loop.wanted  # a status covers a second: one tick more or less is no news
        slow = "!" if service.is_there and is_slow else ""
        late, worst = f"{1e3 * loop.late:.2f}", f"{1e3 * loop.worst:.2f}"
        cells = numbers(f"~{loop.wanted:.0f}", f"{slow}{loop.rate:.1f}", late, worst, f"{loop.skipped}")
        yield f'<tr class="{"" if service.is_there else "k-old"}"><td>{escape(loop.name)}</td>{cells}</tr>'
    if service.text:
        yield f'<tr><td colspan="6" class="dim" style="white-space:normal">{escape(service.text)}</td></tr>'


def anomaly_html(seen: Seen) -> str:
    """The score in words."""
    anomaly = seen.fresh(seen.anomaly)
    if anomaly is None or not math.isfinite(anomaly.score):
        told = "Not judged: no score comes, or it is not known what is normal."
        return page(f'<div style="min-height:30px" class="dim">{told}</div>')
    kind = {"anomaly": "lost", "environment": "poor"}.get(anomaly.verdict, "good")
    word = {"": "nothing to judge", "environment": "environment changed"}.get(anomaly.verdict, anomaly.verdict)
    blamed = f"{'most likely wrong' if anomaly.is_anomaly else 'contributes most'}: {anomaly.blamed or '–'}"
    score = f'score <b>{anomaly.score:.1f}</b> <span class="dim">threshold</span> {anomaly.threshold:.1f}'
    return page(
        f'<div style="display:flex;justify-content:space-between"><span>{score}</span>'
        f'<span class="{kind}">{escape(word)}</span></div><div class="dim">{escape(blamed)}</div>'
    )


def bias_html(found: Map | None, picture: str, update: Update | None) -> str:
    """The bias map with what the update does."""
    facts = '<span class="dim">update</span> not heard of'
    if update is not None:
        state = "resting" if not update.active else "learning" if update.settled else "recognising"
        loss = f", loss {update.loss:.4f}" if math.isfinite(update.loss) else ""
        facts = f'<span class="dim">update</span> {state}, model {update.model_version}, window {update.window}{loss}'
        facts += f", W rolled back {update.rolled_back} times" if update.rolled_back else ""
    if found is None:
        told = "This model knows one body only: no condition has a p of its own."
        return page(f'<div>{facts}</div><div class="dim" style="margin-top:8px">{told}</div>')
    near = "p is not told yet"
    if found.nearest:
        near = f"nearest condition: <b>{escape(found.nearest)}</b>"
        near += f' <span class="dim">at {found.apart:.0%} of the spread</span>'
    legend = "▫ trained condition   ⊕ p now, and where it came from"
    return page(f'{picture}<div class="dim" style="white-space:pre">{legend}</div><div>{near}</div><div>{facts}</div>')


def teach_html(is_taught: bool, is_moving: bool, said: str, file: TaughtFile) -> str:
    """How teaching goes, and where the samples are."""
    state = '<span class="dim">○ not taken over</span>'
    if is_taught:
        state = '<span class="poor">◆ moving</span>' if is_moving else '<span class="good">● holding</span>'
    told = f'<div style="min-height:30px;white-space:normal">{escape(said)}</div>'
    where = f'<div class="dim">{file.recorded} recorded here, in {escape(str(file.path))}</div>'
    return page(f"<div><b>{state}</b></div>{told}{where}")
