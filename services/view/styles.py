"""Style sheet of the page, tables with aligned numbers, and what is added to viser's HTML."""

from collections.abc import Iterable, Sequence

STYLE = """<style>
.gm{padding:0 8px;font:12px/15px ui-sans-serif,system-ui,'Segoe UI',sans-serif;color:#d6dbe3}
.gm table{border-collapse:collapse;width:100%;table-layout:fixed;font-variant-numeric:tabular-nums}
.gm td,.gm th{padding:0 4px;white-space:nowrap;overflow:hidden;text-overflow:ellipsis;text-align:left;font-weight:400}
.gm td.n,.gm th.n{text-align:right;font-family:ui-monospace,'DejaVu Sans Mono',monospace;font-size:11.5px}
.gm tr.h th{color:#8b95a5;font-size:11px;border-bottom:1px solid #39404c;padding-top:1px}
.gm tr.s th{color:#f0f3f8;font-weight:600;padding-top:4px;border-bottom:1px solid #2c323c}
.gm tr.s th small{color:#8b95a5;font-weight:400;font-size:11px}
.gm span.k-measured{color:#7cc0ff}.gm .k-estimated span,.gm tr.s th small.k-estimated{color:#ffb454}
.gm span.k-masked{color:#c792ea}.gm span.k-old{color:#8b95a5}
.gm tr.k-estimated td{background:#ffb45414}.gm tr.k-masked td{background:#c792ea18}
.gm tr.k-old td{color:#7d8694;font-style:italic}
.gm tr td.v{color:#f0f3f8}.gm tr.k-old td.v{color:#7d8694}
.gm .u,.gm .dim{color:#8b95a5}
.gm .b{border-radius:6px;padding:7px 10px 8px;border-left:6px solid;min-height:66px}
.gm .b b{font-size:15px;line-height:19px;display:block}.gm .b b i{font-style:normal;margin-right:7px}
.gm .b .also{color:#aab3c0;margin-top:3px;border-top:1px solid #ffffff1a;padding-top:3px}
.gm .ok{background:#12301f;border-color:#3fb96f}.gm .note{background:#14304a;border-color:#5aa9ee}
.gm .warn{background:#3a2c10;border-color:#ffb454}.gm .bad{background:#451a1c;border-color:#ff6b6b}
.gm .gone{background:#2b2e35;border-color:#9aa3b2}
.gm .facts{display:grid;grid-template-columns:62px 1fr;gap:0 8px;margin:6px 2px}
.gm .facts span:nth-child(odd){color:#8b95a5}
.gm .facts>span{white-space:nowrap;overflow:hidden;text-overflow:ellipsis}
.gm .legend{display:flex;flex-wrap:wrap;gap:0 12px;font-size:11px;margin:2px 0 6px}
.gm .good{color:#63d297}.gm .poor{color:#ffb454}.gm .lost{color:#ff7b7b}
.gm-old{opacity:.45}
.gm-map{width:100%;display:block}.gm-map .frame{fill:#171a20;stroke:#39404c}
.gm-map .grid{stroke:#2a303a;fill:none}.gm-map .axis{fill:#8b95a5;font:10px sans-serif}
.gm-map .condition{fill:none;stroke:#7cc0ff;stroke-width:1.5}.gm-map .condition.near{fill:#7cc0ff}
.gm-map .label{fill:#b7c0cd;font:10.5px sans-serif}.gm-map .label.near{fill:#fff;font-weight:600}
.gm-map .way{fill:none;stroke:#ffb454;stroke-width:1.5;opacity:.7}
.gm-map .now{fill:none;stroke:#ffb454;stroke-width:2}
</style>"""


ALIVE = "/alive"
"""Below the link this path answers while the program runs."""
END = b"</body>"
ADDITIONS = b"""<style>
.mantine-Paper-root[style*="bottom: 0px"][style*="20em"]{width:100%!important;max-height:56%!important}
.mantine-Paper-root[style*="bottom: 0px"][style*="20em"] div[style*="width: 20em"]{width:100vw!important}
#gm-ended{display:none;position:fixed;inset:0;z-index:2147483647;background:#14171ce6;color:#f0f3f8;
font:16px/1.5 system-ui,'Segoe UI',sans-serif;align-items:center;justify-content:center;padding:16px}
#gm-ended div{max-width:30em;background:#2b2e35;border-left:6px solid #9aa3b2;border-radius:8px;padding:16px 20px}
#gm-ended b{font-size:20px;display:block;margin-bottom:6px}#gm-ended p{margin:6px 0}
</style>
<div id="gm-ended" role="alert"><div><b>This page has ended</b>
<p>Since <span id="gm-since"></span> its program, <code>gemuco view</code>, does not answer. It was stopped, or the
connection to its computer is lost. What is behind this text is old.</p>
<p>The robot does not depend on this page. Start <code>gemuco view</code> again and open the link that it prints. If
only the connection was lost, the page goes on by itself.</p></div></div>
<script>
(() => {
  const box = document.getElementById("gm-ended"), link = location.pathname.replace(/\\/$/, "");
  let missed = 0, last = new Date();
  setInterval(async () => {
    try {
      const answer = await fetch(link + "/alive", {cache: "no-store", signal: AbortSignal.timeout(3000)});
      missed = answer.ok ? 0 : missed + 1;
    } catch { missed += 1; }
    if (missed === 0) last = new Date();
    if (missed === 2) document.getElementById("gm-since").textContent = last.toLocaleTimeString();
    if (missed !== 1) box.style.display = missed ? "flex" : "none";
  }, 1500);
})();
</script>
"""


def page(content: str) -> str:
    """Return a part of the page in its own style."""
    return f'<div class="gm">{content}</div>'


def table(widths: Sequence[int], heads: Sequence[str], lines: Iterable[str]) -> str:
    """Return a table with columns of fixed width.

    Args:
        widths: Widths of the columns [%].
        heads: Titles of the columns; a title that begins with `>` is aligned with numbers.
        lines: Rows in HTML.
    """
    columns = "".join(f'<col style="width:{width}%">' for width in widths)
    titles = "".join(f'<th class="n">{one[1:]}</th>' if one.startswith(">") else f"<th>{one}</th>" for one in heads)
    return f'<table><colgroup>{columns}</colgroup><tr class="h">{titles}</tr>{"".join(lines)}</table>'


def numbers(*cells: str) -> str:
    """Return cells of numbers; `~` before a number makes it grey, `!` amber."""
    marks = {"~": "u", "!": "poor"}
    return "".join(f'<td class="n {marks.get(c[:1], "")}">{c[1:] if c[:1] in marks else c}</td>' for c in cells)


def with_ending(html: bytes) -> bytes:
    """Return a page with the additions; other content stays as it is."""
    at = html.rfind(END)
    return html if at < 0 else html[:at] + ADDITIONS + html[at:]
