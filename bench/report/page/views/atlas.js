/* The atlas of breakdowns: a cell per axis and renderer; a cell opens its curve, and pictures of both sides of its breakdown. */
(function (bench) {
  "use strict";

  const {element, fill, soft, later, copied} = bench.dom;
  const SHADES = ["#fbf4e6", "#dbe0e3", "#b4c9d8", "#7ba0bd", "#4f7fa4", "#255a82", "#0b2f4f"]; // from at once to never

  function atlas(data) {
    const opened = element("div.opened", {"aria-live": "polite"});
    const names = data.rows.map((row) => element("th.turned", {scope: "col"}, element("span", null, row)));
    const lines = data.axes.flatMap((axis, line) => {
      const first = line === 0 || data.axes[line - 1].group !== axis.group;
      const cells = data.rows.map((_, index) => element("td", null, cell(data, line, index, opened)));
      const title = element("th.words", {scope: "row"}, axis.title, element("small", null, axis.unit));
      return [first && group(axis.group, data.rows.length), element("tr", null, title, cells)];
    });
    const swatches = SHADES.map((colour) => painted(element("span", {"aria-hidden": "true"}), colour));
    const after = "survives the severest. × breaks at the mildest, ↑ fails only at the mildest, – lacks the setting or refuses the field. Choose a cell: its numbers, curve and pictures open.";
    return element("div.atlas", null,
      element("div.key", null, "breaks at the mildest severity", element("span", null, swatches), after),
      element("div.wide", {tabindex: 0, role: "region", "aria-label": "Breakdowns by axis and renderer"},
        element("table.heat", null,
          element("thead", null, element("tr", null, element("th.words", {scope: "col"}, "Axis"), names)),
          element("tbody", {keydown: follow}, lines))),
      opened);
  }

  /* The title of a group of axes, in a cell of its own that stays in sight when scrolled. */
  const group = (title, columns) =>
    element("tr.group", null, element("th.words", {scope: "rowgroup"}, title), element("td", {colspan: columns}));

  function painted(made, background, color = "") {
    Object.assign(made.style, {background, color});
    return made;
  }

  const words = (result) => (result.status === "unsupported" ? result.status : result.full);

  function cell(data, line, index, opened) {
    const result = data.cells[line][index];
    if (!result) return null;
    const click = ({currentTarget}) => {
      for (const other of document.querySelectorAll(".cell[aria-pressed]")) other.removeAttribute("aria-pressed");
      currentTarget.setAttribute("aria-pressed", "true");
      open(data.axes[line], data.rows[index], result, opened);
      currentTarget.scrollIntoView({block: "nearest", inline: "nearest"}); // of a table that has become narrower
    };
    const label = `${data.axes[line].title}, ${data.rows[index]}: ${words(result)}`;
    const button = element("button.cell", {type: "button", "aria-label": label, click}, result.mark);
    if (result.shade === null) return button;
    const step = Math.min(SHADES.length - 1, Math.floor(result.shade * SHADES.length));
    return painted(button, SHADES[step], result.mark === "×" ? "#b3261e" : step > 3 ? "#fff" : "#1c2430");
  }

  /* Arrow keys go from cell to cell. */
  function follow(event) {
    const step = {ArrowUp: [-1, 0], ArrowDown: [1, 0], ArrowLeft: [0, -1], ArrowRight: [0, 1]}[event.key];
    const at = event.target.closest("td");
    if (!step || !at) return;
    const rows = [...at.closest("tbody").querySelectorAll("tr:not(.group)")];
    const row = rows[rows.indexOf(at.parentElement) + step[0]];
    const next = row && row.children[[...at.parentElement.children].indexOf(at) + step[1]];
    if (!next || !next.querySelector("button")) return;
    event.preventDefault();
    next.querySelector("button").focus();
  }

  function open(axis, row, result, opened) {
    const run = bench.runs.indexOf(result.folder);
    const isListed = run !== undefined;
    fill(opened,
      element("h2", null, `${axis.title}, ${row}`),
      element("p", null, `Breakdown: ${words(result)}. ${result.reason || ""} `,
        isListed ? element("a", {href: bench.runs.link(run)}, "The run") : soft("Its run is not among these results.")),
      thumbnails(result.pictures || {}),
      rays(result.ray || {}),
      later(curves(), (panels) => {
        const panel = panels.find((each) => each.axis === axis.axis);
        return panel && bench.chart({panels: [panel]}, {label: `Share of successes on ${axis.title}`, focus: row});
      }),
      isListed && later(bench.runs.detail(run), large));
    if (getComputedStyle(opened).position !== "sticky") opened.scrollIntoView({block: "nearest"});
  }

  /* The kinds of errors in a rendering that succeeds, and in one that fails. */
  function thumbnails(pictures) {
    const shown = ["works", "breaks"].filter((name) => pictures[name]);
    const figures = shown.map((name) => element("figure", null,
      element("img", {src: pictures[name], alt: `Errors of a rendering that ${pictures[`${name}_text`]}`}),
      element("figcaption", null, pictures[`${name}_text`])));
    if (!figures.length) return null;
    return [element("div.thumbnails", null, figures), element("p", null, soft("Grey: right hits. Red: missed. Blue: spurious. Orange: another surface, or not a number. A pixel shows the worst of 2 × 2 if the rendering has more than 64 per side."))];
  }

  /* The commands that draw the ray of the most wrong pixel, where the renderer breaks and where it does not. */
  const rays = ({command, breaks, works}) =>
    [["The most wrong pixel at a severity that breaks it:", breaks], ["And at one that does not, where few pixels are wrong:", works]]
      .filter(([, level]) => typeof level === "number")
      .map(([text, level]) => [soft(text), copied(`${command} level=${Number(level.toFixed(6))}`, text)]);

  /* The curves of all axes, which stand in a page of their own. */
  async function curves() {
    const paper = bench.store.have("list", "papers").find(({name}) => name === "stability_curves");
    const data = paper && (await bench.store.load("paper", paper.key));
    return data && data.chart ? data.chart.panels : [];
  }

  function large({pictures}) {
    const result = pictures.find(([name]) => name === "failure.png");
    if (!result) return soft("This run has no picture of its breakdown.");
    const [, src, alt] = result;
    return element("figure", null, element("img.figure", {src, alt}), element("figcaption", null, alt));
  }

  bench.atlas = atlas;
})((window.implicitBench = window.implicitBench || {}));
