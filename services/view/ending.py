"""Additions to the page's HTML: words for the end of its program, and the whole width of a phone."""

ALIVE = "/alive"
"""Below the link this path answers while the program runs."""
TAG = b"</body>"
SCRIPT = b"""<style>
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


def with_ending(html: bytes) -> bytes:
    """Return a page with the additions; other content stays as it is."""
    at = html.rfind(TAG)
    return html if at < 0 else html[:at] + SCRIPT + html[at:]
