"""The style sheet and the script of a report.

Colours are CSS variables with a light and a dark value; curves take theirs from the same names, see
:data:`minisplat_ref.interface.palette.PAGE_NAMES`. The script turns every ``.slider``, which without it is a row of
images, into one image: the first on the left of a line, another on the right. The line moves with the range below,
by keyboard as well, or with the pointer on the image.
"""

STYLE = """
:root {
  color-scheme: light dark;
  --page: #f6f7f9; --panel: #fff; --ink: #25303b; --soft: #4a5560; --faint: #616c78; --code: #eef2f6;
  --rule: #e3e7eb; --grid: #e6eaee; --edge: #8a94a0; --bad: #b3261e; --good: #2f6f3a;
  --red: #b4553d; --blue: #2d6a8e; --green: #4b7f52; --purple: #8a5a9e; --ochre: #b08a2e; --grey: #5a6570;
  --teal: #2c7f86; --brown: #8c5a2e;
}
@media (prefers-color-scheme: dark) {
  :root {
    --page: #13171c; --panel: #1b2128; --ink: #e4e9ee; --soft: #b9c2cb; --faint: #98a3ae; --code: #252d35;
    --rule: #2e3740; --grid: #29313a; --edge: #6d7883; --bad: #ff8a80; --good: #8fcf9a;
    --red: #e58f78; --blue: #79b4da; --green: #88c092; --purple: #c49bd8; --ochre: #dcb862; --grey: #a5b0bb;
    --teal: #6cc3c8; --brown: #cf9d6c;
  }
}
* { box-sizing: border-box }
body { margin: 0; background: var(--page); color: var(--ink); font: 16px/1.55 system-ui, "DejaVu Sans", sans-serif;
  -webkit-text-size-adjust: 100% }
main { max-width: 1080px; margin: 0 auto; padding: 40px 24px 64px; overflow-wrap: anywhere }
h1 { font-size: 30px; line-height: 1.2; margin: 0 0 8px; font-weight: 650 }
h2 { font-size: 20px; margin: 48px 0 4px; font-weight: 600 }
summary h2 { display: inline-block; cursor: pointer }
p, ul { margin: 4px 0 16px; color: var(--soft); max-width: 74ch }
a { color: var(--blue) }
ul { padding-left: 20px; font-size: 15px }
.cards { display: grid; grid-template-columns: repeat(auto-fit, minmax(150px, 1fr)); gap: 12px; margin: 24px 0 }
.card, .panel { background: var(--panel); border: 1px solid var(--rule); border-radius: 10px }
.card { padding: 14px 16px }
.card b { display: block; font-size: 24px; line-height: 1.25; font-weight: 600; font-variant-numeric: tabular-nums }
.card span { display: block; margin-top: 4px; color: var(--faint); font-size: 13.5px; line-height: 1.4 }
.panel { padding: 16px; margin: 12px 0 }
.row { display: grid; grid-template-columns: repeat(var(--columns, 3), minmax(0, 1fr)); gap: 12px 16px;
  align-items: start }
.label { font-size: 14px; color: var(--soft); margin: 0 0 8px }
figure { margin: 0; min-width: 0 }
figure img { display: block; width: 100%; height: auto; border-radius: 4px }
figcaption { color: var(--faint); font-size: 13.5px; line-height: 1.4; padding: 6px 0 2px }
.pixels img { image-rendering: pixelated }
svg { display: block; width: 100%; height: auto; overflow: visible }
.scroll { overflow: auto; padding: 0; border-radius: 10px }
.tall { max-height: 80vh }
.scroll:focus-visible, summary:focus-visible { outline: 2px solid var(--blue); outline-offset: 2px }
table { border-collapse: collapse; width: 100%; font-size: 15px; line-height: 1.45 }
td, th { padding: 6px 16px 6px 0; border-bottom: 1px solid var(--rule); vertical-align: top; text-align: left }
th { font-weight: 600 }
thead th { vertical-align: bottom; position: sticky; top: 0; background: var(--panel); z-index: 2 }
td { font-variant-numeric: tabular-nums }
tbody tr:last-child > * { border-bottom: 0 }
tbody th { color: var(--faint); font-weight: 400 }
td:first-child, th:first-child { padding-left: 16px }
.facts tbody th { width: 22% }
.data { font-size: 14px }
.data td, .data th { white-space: nowrap }
.data .long { white-space: normal; min-width: 34ch }
.data th:first-child { position: sticky; left: 0; background: var(--panel); z-index: 1 }
.data thead th:first-child { z-index: 3 }
.data tbody th { color: var(--ink); white-space: normal; min-width: 14ch; max-width: 30ch; overflow-wrap: break-word }
.bad { color: var(--bad); font-weight: 600 }
.good { color: var(--good) }
pre { background: var(--code); border-radius: 8px; padding: 12px 14px; margin: 6px 0 16px; overflow-x: auto }
code, pre { font: 14px/1.5 ui-monospace, "DejaVu Sans Mono", monospace }
.slider { display: grid; grid-template-columns: repeat(auto-fit, minmax(140px, 1fr)); gap: 12px }
.slider.live { grid-template-columns: 1fr; gap: 8px; position: relative }
.slider.live figure { grid-area: 1 / 1; position: relative }
.slider.live figcaption { display: none }
.slider.live figure:first-child { z-index: 1; clip-path: inset(0 calc(100% - var(--at)) 0 0); pointer-events: none }
.slider.live .line { grid-area: 1 / 1; z-index: 2; width: 2px; margin-left: calc(var(--at) - 1px);
  background: #fff; box-shadow: 0 0 0 1px #0008; pointer-events: none }
.slider .bar { display: flex; align-items: center; gap: 12px; color: var(--faint); font-size: 13.5px }
.slider input { flex: 1; min-width: 60px; height: 28px; margin: 0; accent-color: var(--blue); cursor: ew-resize }
.slider select { font: inherit; color: var(--ink); background: var(--code); border: 1px solid var(--edge);
  border-radius: 6px; padding: 4px 6px; max-width: 45% }
@media (max-width: 700px) {
  main { padding: 24px 14px 48px }
  h1 { font-size: 25px }
  .row { grid-template-columns: minmax(0, 1fr) }
  .cards { grid-template-columns: repeat(2, minmax(0, 1fr)); gap: 8px }
  .card { padding: 10px 12px }
  .card b { font-size: 20px }
  .panel { padding: 12px }
  .panel.scroll { padding: 0 }
  td:first-child, th:first-child { padding-left: 12px }
  .data tbody th { max-width: 38vw; min-width: 0 }
  .facts tbody th { width: 30% }
  pre { white-space: pre-wrap }
  .wide thead { display: none }
  .wide, .wide tbody, .wide tr, .wide th, .wide td { display: block }
  .wide tr { padding: 8px 12px; border-bottom: 1px solid var(--rule) }
  .data.wide tbody th { max-width: none; font-weight: 600; position: static }
  .data.wide td, .data.wide th { border: 0; padding: 1px 0; white-space: normal; min-width: 0 }
  .wide td:empty { display: none }
  .wide td::before { content: attr(data-label) ": "; color: var(--faint) }
}
@media print { .panel, .card { break-inside: avoid } }
"""

SCRIPT = """
for (const box of document.querySelectorAll(".slider")) {
  const [first, ...others] = box.querySelectorAll("figure");
  const name = figure => figure.querySelector("figcaption").textContent;
  const make = (tag, values) => Object.assign(document.createElement(tag), values);
  const line = make("div", {className: "line"}), bar = make("div", {className: "bar"});
  const range = make("input", {type: "range", min: 0, max: 100, value: 50});
  const choice = make("select");
  choice.append(...others.map(other => new Option(name(other))));
  choice.setAttribute("aria-label", "image on the right");
  const show = () => {
    const right = others[choice.selectedIndex];
    others.forEach(other => { other.hidden = other !== right; });
    box.style.setProperty("--at", range.value + "%");
    range.setAttribute("aria-label", name(first) + " on the left, " + name(right) + " on the right");
  };
  const follow = event => {
    if (!event.buttons || bar.contains(event.target)) return;
    const {left, width} = box.getBoundingClientRect();
    range.value = 100 * (event.clientX - left) / width;
    show();
  };
  range.addEventListener("input", show);
  choice.addEventListener("change", show);
  box.addEventListener("pointerdown", follow);
  box.addEventListener("pointermove", follow);
  box.querySelectorAll("img").forEach(image => { image.draggable = false; });
  bar.append(name(first), range, others.length > 1 ? choice : name(others[0]));
  box.append(line, bar);
  box.classList.add("live");
  show();
}
"""
