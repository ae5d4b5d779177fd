"""The page's own script, and the server's answer to it: whether the page still has a server and a mapping
process behind it.

viser's client notices only that its socket is closed, and a process that is stopped closes nothing. It keeps
the last words of the panel, which may be "done". So the script asks each second, says in words what does not
answer, and hides what the panel says is being done. It lets the client connect again also without the focus,
and reloads the page of a server that answers while the socket stays closed.

The script also gives the page the colours that the system prefers until a user turns them over, and shows the
tooltips of labels. On a phone it folds the panel at first, makes it as wide as the window, opens it for the
answer to a click, and leaves out viser's initial view of wide windows, which may come after the page's own.
It writes the view into the page's address when its user asks for a link, and begins with the view of such an
address in place of the first one that the server sends.
"""

import http
import json
from pathlib import Path
from time import monotonic

from websockets.asyncio.server import ServerConnection
from websockets.http11 import Response

SILENCE_S = 30.0
"""A mapping process that has sent nothing for so long does not answer. It sends Alive each BEAT_S, but not
while a kernel is compiled, which took 8.5 s at most with an empty cache (2 cores)."""

PATH = "/alive"

ACTIVITY = "taichi-mrf-activity"
"""The class of the element that says what is being done."""

LINK = "Link to this view"
"""Label of the button that writes the view into the page's address."""

SCRIPT = (
    (
        """(() => {
const EVERY_MS = 1000, PATIENCE_MS = 3000, MOST_IN_VAIN = 20, KEPT = "taichi-mrf-scheme";
document.hasFocus = () => true;  // viser's client connects again only where the page has the focus
let timer, socket, theme, wasOpen = false, closed = false, hasClosed = false, inVain = 0;
const root = document.documentElement, system = matchMedia("(prefers-color-scheme: dark)");
const preferred = () => system.matches ? "dark" : "light";
const numbers = location.hash.match(/^#view=([-+.,\\de]+)$/)?.[1].split(",").map(Number) ?? [];
const isLink = [9, 12].includes(numbers.length) && numbers.every(Number.isFinite);
const linked = isLink ? {
  SetCameraPositionMessage: ["position", numbers.slice(0, 3)],
  SetCameraLookAtMessage: ["look_at", numbers.slice(3, 6)],
  SetCameraUpDirectionMessage: ["position", numbers.slice(6, 9)],
} : {};
let view;
const scheme = () => localStorage.getItem(KEPT) ?? preferred();
window.Worker = class extends Worker {  // viser's socket lives in one, which tells of it
  constructor(...given) {
    super(...given);
    socket = this;
    this.addEventListener("message", ({data}) => {
      if (innerWidth <= innerHeight || isLink) data.messages = data.messages?.filter(({initial}) => !initial);
      for (const message of data?.messages ?? []) {
        if (linked[message.type]) {
          const [name, value] = linked[message.type];
          message[name] = value;
          delete linked[message.type];
          const lens = ["Fov", "Near", "Far"].map((part, i) => [part, numbers[9 + i]]);
          if (name === "look_at" && numbers.length === 12) lens.forEach(([part, value]) => data.messages.push(
            {type: `SetCamera${part}Message`, [part.toLowerCase()]: value, initial: false}));
        }
        if (message.type !== "ThemeConfigurationMessage") continue;
        theme = message;
        if (theme.dark_mode) {  // the server asks for the other colours
          const other = scheme() === "dark" ? "light" : "dark";
          other === preferred() ? localStorage.removeItem(KEPT) : localStorage.setItem(KEPT, other);
        }
        theme.dark_mode = scheme() === "dark";
      }
      if (data?.messages?.some(({type}) => type.startsWith("Gui"))) setTimeout(showAnswer, 200);
      if (data?.type === "connected") [wasOpen, closed] = [true, false];
      if (data?.type === "closed") [closed, hasClosed] = [true, true];
    });
  }
  postMessage(data, ...rest) {
    if (data?.message?.type === "ViewerCameraMessage") view = data.message;
    super.postMessage(data, ...rest);
  }
};
document.addEventListener("click", ({target}) => {
  if (!view || target.closest?.("button")?.textContent !== "LINK") return;
  const {position, look_at, up_direction, fov, near, far} = view;
  const parts = [...position, ...look_at, ...up_direction, fov, near, far].map(part => part.toFixed(4));
  history.replaceState(null, "", "#view=" + parts);
  navigator.clipboard?.writeText(location.href).catch(() => {});
}, true);
system.addEventListener("change", () => {
  const data = {type: "message_batch", messages: [{...theme, dark_mode: false}]};
  if (theme) socket.dispatchEvent(new MessageEvent("message", {data}));
});
const headOfSheet = () => document.querySelector('[style*="cursor: pointer"][style*="; height: 3.5em"]');
const fold = () => headOfSheet() ? headOfSheet().click() : requestAnimationFrame(fold);
const narrow = matchMedia("(max-width: 36em)");  // the width from which on viser has a floating panel
if (narrow.matches) fold();
let answer = "", opened = false;  // what the answer says, and whether it has opened the panel of a phone
const showAnswer = () => {
  const head = narrow.matches && document.querySelector('[aria-label$=" panel Answer"]');
  const said = head?.nextElementSibling?.textContent ?? "";
  const isOpen = headOfSheet()?.querySelector("button");  // there at once, while the height grows
  if (!head && opened && isOpen) headOfSheet().click();
  if (!head) opened = false;
  if (head && said !== answer) {
    if (!isOpen) [opened] = [true, headOfSheet().click()];
    for (const ms of [0, 500, 1500]) setTimeout(() => head.scrollIntoView(), ms);  // while it grows
  }
  answer = said;
};
for (const [event, inner] of [["mouseover", "mouseenter"], ["mouseout", "mouseleave"]])
  document.addEventListener(event, ({target}) => {  // the label of a widget shows its tooltip, too
    const widget = target.matches?.("label[for]") && target.parentElement.parentElement.nextElementSibling;
    if (widget) widget.firstElementChild?.dispatchEvent(new MouseEvent(inner));
  });
const style = document.createElement("style");
style.textContent = `
  [style*="min-width: fit-content"] { padding-inline: 0.3em !important; }  /* five buttons in a row */
  [data-dock-tab] { padding-inline: 0.5em !important; }  /* six tabs in a row */
  [style*="padding-bottom: 0.5em"] { padding-bottom: 0.3em !important; }  /* all layers without scrolling */
  p:has(> label[for]) { color: inherit !important; }  /* grey on grey else */
  [style*="width: 3rem"] { width: 3.75rem !important; }  /* six figures beside a slider */
  div:has(> .mantine-Slider-markWrapper:nth-child(4)) .mantine-Slider-mark {  /* lines: many dots merge */
    width: 1px !important; height: 0.75rem; border: 0; border-radius: 0; background: #868e96;
    transform: translateY(-0.2rem) !important; }
  [role=tab][aria-selected=true] { color: light-dark(#1971c2, #4dabf7) !important; }
  [role=tablist]:has(> [data-dock-tab]:only-child) { display: none !important; }  /* the name of one tab */
  @media (max-width: 36em) {
    [style*="width: 20em"] { width: 100% !important; }
    [style*="position: fixed"][style*="width: 20em"] { max-height: 45% !important; }  /* the map stays seen */
    [aria-label^="Collapse panel "] + div { height: auto !important; }  /* 0 if it was opened unseen */
    [style*="cursor: pointer"][style*="; height: 3.5em"]::after { content: "▴▾"; padding-left: 1em; }
  }
  html[data-cut-off] :is(.ACTIVITY, .mantine-Progress-root) { visibility: hidden; }
  #cut-off { position: fixed; inset: 0 25em auto 0; z-index: 100000; padding: 0.6em; text-align: center;
    font: 600 16px sans-serif; color: #fff; background: #c92a2a; pointer-events: none; }
  html:not([data-cut-off]) #cut-off { display: none; }
  @media (max-width: 36em) { #cut-off { right: 0; } }`;
document.head.append(style);
const banner = document.createElement("div");
banner.id = "cut-off";
banner.setAttribute("role", "alert");
const say = words => {
  if (words !== banner.textContent) banner.textContent = words;
  if (!banner.isConnected) document.body.append(banner);
  root.toggleAttribute("data-cut-off", words !== "");
};
const GONE = "disconnected: reload the page if it does not come back by itself";
const ask = async () => {
  const begun = performance.now();
  try {
    const answer = await fetch("alive", {cache: "no-store", signal: AbortSignal.timeout(PATIENCE_MS)});
    if (!answer.ok) throw new Error(answer.statusText);
    const {mapper} = await answer.json();
    // Answers of a server to which the socket does not come back. A full server opens and closes it at once.
    inVain = closed || hasClosed ? inVain + 1 : 0;
    hasClosed = false;
    if (wasOpen && inVain > MOST_IN_VAIN) return location.reload();
    say(closed ? GONE : mapper ? "" : "the mapper does not answer");
  } catch {
    // A page that slept or was busy itself is no sign of the server; it asks again.
    if (performance.now() - begun < PATIENCE_MS + 1000) say(GONE);
  }
  timer = setTimeout(ask, EVERY_MS);
};
timer = setTimeout(ask, EVERY_MS);
document.addEventListener("visibilitychange", () => {  // timers of a hidden page are slow
  if (document.hidden || !timer) return;
  clearTimeout(timer);
  ask();
});
})();"""
    )
    .replace("ACTIVITY", ACTIVITY)
    .replace("LINK", LINK)
)
"""Runs before viser's own scripts."""

TAG = f"<script>{SCRIPT}</script>"


class Pulse:
    """Answer to the page's script: whether the mapping process still speaks."""

    def __init__(self, mapper: int | None = None) -> None:
        """``mapper`` is the number of the mapping process, None without one."""
        self._mapper, self._heard_s = mapper, monotonic()

    def heard(self) -> None:
        """Note that the mapping process has sent something."""
        self._heard_s = monotonic()

    def answer(self, connection: ServerConnection) -> Response:
        """The answer to a request for :data:`PATH`."""
        silent = monotonic() - self._heard_s > SILENCE_S
        speaks = self._mapper is None or not (silent or _is_stopped(self._mapper))
        response = connection.respond(http.HTTPStatus.OK, json.dumps({"mapper": speaks}))
        response.headers["Cache-Control"] = "no-store"
        return response


def _is_stopped(process: int) -> bool:
    """True if a signal has stopped the process; False where the system does not say (other than Linux)."""
    try:
        status = Path(f"/proc/{process}/stat").read_text()
    except OSError:
        return False
    return status.rpartition(")")[2].split()[0] in ("T", "t")
