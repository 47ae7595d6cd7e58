/* The atlas of breakdowns: a cell per axis and renderer; a cell opens its curve and its first failure beside the truth. */
(function (bench) {
  "use strict";

  const {element, fill} = bench.dom;
  const SHADES = ["#8c2d04", "#cc6a1a", "#f0b46a", "#f3ead8", "#a9cfe3", "#4a90c2", "#0b4f8a"]; // from at once to never

  function atlas(data) {
    const opened = element(
      "div.opened",
      {"aria-live": "polite"},
      element("p.soft", null, "Choose a cell: its curve and its first failure open here."),
    );
    const head = element(
      "tr",
      null,
      element("th.words", {scope: "col"}, "Axis"),
      data.rows.map((row) => element("th.turned", {scope: "col"}, element("span", null, row))),
    );
    const lines = data.axes.flatMap((axis, line) => {
      const group =
        line === 0 || data.axes[line - 1].group !== axis.group
          ? [
              element(
                "tr.group",
                null,
                element("th.words", {scope: "rowgroup"}, axis.group), // a cell of its own stays in sight when scrolled
                element("td", {colspan: data.rows.length}),
              ),
            ]
          : [];
      return [
        ...group,
        element(
          "tr",
          null,
          element("th.words", {scope: "row"}, axis.title, element("small", null, axis.unit)),
          data.rows.map((row, place) => element("td.shade", null, cell(data, line, place, opened))),
        ),
      ];
    });
    return element(
      "div.atlas",
      null,
      element(
        "div.key",
        null,
        "breaks at the mildest severity",
        element("span", null, SHADES.map(swatch)),
        "does not break at the severest",
      ),
      element(
        "div.wide",
        {tabindex: 0, role: "region", "aria-label": "Breakdowns by axis and renderer"},
        element("table.heat", null, element("thead", null, head), element("tbody", {keydown: follow}, lines)),
      ),
      opened,
    );
  }

  function swatch(colour) {
    const made = element("span", {"aria-hidden": "true"});
    made.style.background = colour;
    return made;
  }

  function cell(data, line, place, opened) {
    const found = data.cells[line][place];
    if (!found) return element("span.soft", null, "");
    const button = element(
      "button.cell",
      {
        type: "button",
        "aria-label": `${data.axes[line].title}, ${data.rows[place]}: ${words(found)}`,
        click: (event) => {
          for (const other of document.querySelectorAll(".cell[aria-pressed]")) other.removeAttribute("aria-pressed");
          event.currentTarget.setAttribute("aria-pressed", "true");
          open(data, line, place, opened);
        },
      },
      found.short,
    );
    if (found.shade !== null) {
      const step = Math.min(SHADES.length - 1, Math.floor(found.shade * SHADES.length));
      button.style.background = SHADES[step];
      button.style.color = step < 2 || step > 4 ? "#fff" : "#1c2430";
    }
    return button;
  }

  function words(found) {
    return found.status === "unsupported" ? found.status : found.full;
  }

  /* Arrow keys go from cell to cell. */
  function follow(event) {
    const step = {ArrowUp: [-1, 0], ArrowDown: [1, 0], ArrowLeft: [0, -1], ArrowRight: [0, 1]}[event.key];
    const at = event.target.closest("td");
    if (!step || !at) return;
    let row = at.parentElement;
    const place = [...row.children].indexOf(at) + step[1];
    for (let n = 0; n < Math.abs(step[0]); n++) {
      do row = step[0] > 0 ? row.nextElementSibling : row.previousElementSibling;
      while (row && row.classList.contains("group"));
    }
    const next = row && row.children[place] && row.children[place].querySelector("button");
    if (!next) return;
    event.preventDefault();
    next.focus();
  }

  function open(data, line, place, opened) {
    const [axis, row, found] = [data.axes[line], data.rows[place], data.cells[line][place]];
    const run = bench.runs.place(found.folder);
    const parts = [
      element("h2", null, `${axis.title}, ${row}`),
      element(
        "p",
        null,
        `Breaks: ${words(found)}. `,
        found.reason || "",
        run === undefined
          ? element("span.soft", null, " Its run is not among these results.")
          : element("a", {href: bench.runs.link(run)}, "The run"),
      ),
    ];
    const curve = element("div");
    fill(opened, parts, curve, run === undefined ? null : failure(run));
    curves().then(
      (panels) => {
        const panel = panels.find((each) => each.axis === axis.axis);
        if (panel)
          fill(
            curve,
            bench.chart({panels: [panel]}, {label: `Share of successes on ${axis.title}`, focus: row}),
          );
      },
      () => {},
    );
    if (getComputedStyle(opened).position !== "sticky") opened.scrollIntoView({block: "nearest"});
  }

  /* The curves of all axes, which stand in a page of their own. */
  function curves() {
    const paper = bench.store.have("list", "papers").find(({name}) => name === "stability_curves");
    return paper
      ? bench.store.load("paper", paper.key).then((data) => (data.chart ? data.chart.panels : []))
      : Promise.resolve([]);
  }

  function failure(run) {
    const home = element("div");
    bench.store.load("run", bench.runs.key(run)).then(
      (detail) => {
        const picture = detail.pictures.find(([name]) => name === "failure.png");
        fill(
          home,
          picture
            ? element(
                "figure",
                null,
                element("img.figure", {src: picture[1], alt: picture[2]}),
                element("figcaption", null, picture[2]),
              )
            : element("p.soft", null, "This run has no picture of a failure."),
        );
      },
      () => {},
    );
    return home;
  }

  bench.atlas = atlas;
})((window.implicitBench = window.implicitBench || {}));
