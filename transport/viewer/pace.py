"""How often a page draws, which viser leaves to itself: for 250 ms after every change, and once a second besides.

The page asks its browser for every picture (`requestAnimationFrame`). A script that comes with an element of the panel
holds such requests back until a while after the last picture. Who has just opened the page, moves the mouse or presses
a key waits for nothing.
"""

from html import escape

# How long the page draws as often as it likes after somebody has done something, and after it was opened, ms.
_ACTED_MS, _OPENED_MS = 500, 3000

_SCRIPT = """
window.setPace ??= (() => {
  const next = window.requestAnimationFrame.bind(window), calls = new Map(), held = new Set();
  let gap = 0, drawn = 0, free = performance.now() + OPENED, timer = 0, last = 0;
  const draw = (id) => next((at) => {
    const call = calls.get(id);
    calls.delete(id);
    if (call) { drawn = performance.now(); call(at); }
  });
  const release = () => {
    clearTimeout(timer);
    timer = 0;
    held.forEach(draw);
    held.clear();
  };
  window.requestAnimationFrame = (call) => {
    const id = ++last, now = performance.now(), wait = drawn + gap - now;
    calls.set(id, call);
    if (wait <= 0 || now < free) draw(id);
    else { held.add(id); timer ||= setTimeout(release, wait); }
    return id;
  };
  window.cancelAnimationFrame = (id) => { calls.delete(id); held.delete(id); };
  for (const kind of ['pointerdown', 'pointermove', 'wheel', 'keydown'])
    window.addEventListener(kind, () => {
      free = Math.max(free, performance.now() + ACTED);
      release();
    }, {capture: true, passive: true});
  return (ms) => { gap = ms; release(); };
})();
window.setPace(GAP);
"""


def pace(gap_s: float) -> str:
    """An element without content that lets the page it comes to draw no more often than that.

    Args:
        gap_s: Between two pictures, s; 0 for as often as it likes.
    """
    script = _SCRIPT.replace("GAP", str(round(1e3 * gap_s)))
    script = script.replace("OPENED", str(_OPENED_MS)).replace("ACTED", str(_ACTED_MS))
    # A script element that is put into a page is not run; what an image does that cannot be loaded, is.
    return f'<img hidden alt="" src="data:," onerror="{escape(script)}">'
