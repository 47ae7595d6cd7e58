/* The first screen: each question with its verdict, then the leaderboards; and the page of a table or figure. */
(function (bench) {
  "use strict";

  const {element, fill, details, list, later, emphasised} = bench.dom;
  const link = ({name}) => bench.address.to(["table", name]);
  const all = () => bench.store.have("list", "papers") || [];

  /* Alone, the leaderboards are all that is shown. */
  function overview(home, query, {alone} = {}) {
    const papers = alone ? [] : all();
    const [answered, others] = [papers.filter(({verdict}) => verdict), papers.filter(({verdict}) => !verdict)];
    const boards = element("section", {"aria-labelledby": "board"});
    const group = (id, title, content) =>
      element("section", {"aria-labelledby": id}, element("h2", {id}, title), content);
    const more = answered.length ? "More tables and figures" : "Tables and figures";
    const listed = others.map((paper) => element("li", null, element("a", {href: link(paper)}, paper.title)));
    fill(home,
      element("h1.unseen", null, alone ? "Leaderboards" : "All results"),
      answered.length > 0 && group("answers", "What the tables answer", element("div.verdicts", null, answered.map(card))),
      others.length > 0 && group("others", more, element("ul.links", null, listed)),
      boards);
    if (bench.runs.count) bench.board(boards, query);
    else {
      const example = element("code", null, "python -m bench task=completion renderer=dist");
      fill(boards, element("h2", {id: "board"}, "Runs"), element("p", null, "No run was read. Make one: ", example));
    }
  }

  const card = (paper) =>
    element("a.verdict", {href: link(paper)},
      element("span.question", null, paper.question),
      element("span.answer", null, emphasised(paper.verdict)),
      element("span.from", null, paper.title, paper.shipped ? " · shipped" : ""));

  function paper(home, name) {
    const known = all().find((each) => each.name === name);
    const back = element("p.crumbs", null, element("a", {href: "#/"}, "All results"));
    if (!known) return fill(home, back, element("h1", null, "There is no such table"));
    return fill(home,
      back,
      element("h1", null, known.title || known.name),
      known.question && element("p.question", null, known.question),
      known.verdict && element("p.answer.large", null, emphasised(known.verdict)),
      known.shipped && element("p.note", null, "Shipped with the program: not of the runs on this page."),
      later(bench.store.load("paper", known.key), (data) => parts(known, data)));
  }

  /* What answers the mouse, the picture, the table, caption and files; what shows the same twice is folded. */
  function parts(known, data) {
    const image = () => element("img.figure", {src: data.picture, alt: data.caption || known.title, loading: "lazy"});
    const picture = data.picture && element("figure", null, element("a", {href: data.files.PDF || data.picture}, image()));
    const links = Object.entries(data.files).map(([kind, href]) => [element("a", {href}, kind), " "]);
    const table = data.rows.length > 0 && bench.written(data.header, data.rows);
    return [
      data.atlas && bench.atlas(data.atlas),
      data.chart && bench.chart(data.chart, {label: known.title}),
      picture && (data.atlas || data.chart) ? details("The figure as in the paper", picture) : picture,
      element("p.caption", null, data.caption),
      table && data.atlas ? details("The table, with intervals", table) : table,
      data.notes.length > 0 && details(`Notes and definitions (${data.notes.length})`, list(data.notes)),
      links.length > 0 && element("p.files", null, "Files: ", links),
    ];
  }

  Object.assign(bench, {overview, paper});
})((window.implicitBench = window.implicitBench || {}));
