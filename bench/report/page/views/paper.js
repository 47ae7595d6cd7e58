/* A table or figure: its question and verdict, a chart that answers the mouse, the picture, the table, caption and files. */
(function (bench) {
  "use strict";

  const {element, fill, emphasised} = bench.dom;

  function paper(home, name) {
    const known = (bench.store.have("list", "papers") || []).find((each) => each.name === name);
    if (!known) {
      fill(
        home,
        element("h1", null, "There is no such table"),
        element("p", null, element("a", {href: "#/"}, "To the first page")),
      );
      return;
    }
    const body = element("div", null, element("p.soft", null, "Loading …"));
    fill(
      home,
      element("p.crumbs", null, element("a", {href: "#/"}, "All results")),
      element("h1", null, known.title || known.name),
      known.question ? element("p.question", null, known.question) : null,
      known.verdict ? element("p.answer.large", null, emphasised(known.verdict)) : null,
      body,
    );
    bench.store.load("paper", known.key).then(
      (data) => fill(body, parts(known, data)),
      (error) => fill(body, element("p.note", null, error.message)),
    );
  }

  function parts(known, data) {
    const picture =
      data.picture &&
      element(
        "figure",
        null,
        element(
          "a",
          {href: data.files.PDF || data.picture},
          element("img.figure", {src: data.shown || data.picture, alt: data.caption || known.title, loading: "lazy"}),
        ),
      );
    const answers = data.atlas || data.chart;
    return [
      data.atlas ? bench.atlas(data.atlas) : null,
      data.chart ? bench.chart(data.chart, {label: known.title}) : null,
      picture && answers
        ? element("details", null, element("summary", null, "The figure as in the paper"), picture)
        : picture,
      element("p.caption", null, data.caption),
      table(data),
      data.notes.length
        ? element(
            "details",
            null,
            element("summary", null, `Notes and definitions (${data.notes.length})`),
            element(
              "ul",
              null,
              data.notes.map((note) => element("li", null, note)),
            ),
          )
        : null,
      element(
        "p.files",
        null,
        "Files: ",
        Object.entries(data.files).map(([kind, link]) => [element("a", {href: link}, kind), " "]),
      ),
    ];
  }

  /* The table; under an atlas, which shows the same, it is folded. */
  function table({header, rows, atlas}) {
    if (!rows.length) return null;
    const written = bench.table.written(header, rows);
    return atlas ? element("details", null, element("summary", null, "The table, with intervals"), written) : written;
  }

  bench.paper = paper;
})((window.implicitBench = window.implicitBench || {}));
