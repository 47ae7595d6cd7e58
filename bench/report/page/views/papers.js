/* The first screen: the newest sweep, or the suite; sweeps and leaderboards; all tables; and the page of a table. */
(function (bench) {
  "use strict";

  const {element, fill, section, details, list, later, choice, copied, emphasised} = bench.dom;
  const SUITE = "suite";
  const STANDING = {named: "Renderer", link: (row) => bench.address.to(["renderer", row])};
  const link = ({name}) => bench.address.to(["table", name]);
  const all = () => bench.store.have("list", "papers") || [];
  const find = (name) => all().find((each) => each.name === name);

  function overview(home, query) {
    const [suite, sweeps] = [find(SUITE), all().filter(({asked}) => asked > 0).sort((a, b) => b.asked - a.asked)];
    const boards = element("section", {"aria-labelledby": "board"});
    const [newest] = sweeps;
    const first = newest ? (data) => parts(newest, data) : answer;
    const shown = newest || suite;
    fill(home,
      shown ? [heading(shown), later(bench.store.load("paper", shown.key), first)] : element("h1.unseen", null, "All results"),
      sweeps.length > 0 && section("All sweeps", answers(sweeps)),
      newest && suite && section("The suite", answers([suite])),
      boards);
    bench.board(boards, query);
  }

  /* The chart of the suite, of the set that is chosen, and its table, whose rows lead to the renderers. */
  function answer(data) {
    const {panels = []} = data.chart || {};
    const drawn = element("div");
    const show = (index) => fill(drawn, bench.chart({panels: [{...panels[index], title: ""}]}, {label: panels[index].title}));
    if (panels.length) show(0);
    const titles = Object.fromEntries(panels.map(({title}, index) => [index, title]));
    return [
      panels.length > 1 && choice("Set of problems", titles, "0", show),
      drawn,
      bench.written(data.header, data.rows, STANDING),
      element("p.caption", null, data.caption, " ", element("a", {href: link({name: SUITE})}, "All charts, notes and files")),
    ];
  }

  /* Questions with their verdicts, a line each. */
  function answers(papers) {
    const name = (paper) => [
      element("a", {href: link(paper)}, paper.question || paper.title),
      element("small", null, [paper.question && paper.title, paper.shipped && "shipped"].filter(Boolean).join(" · ")),
    ];
    const columns = [
      {label: "Question", head: true, cell: name},
      {label: "Answer", cell: ({verdict}) => (verdict ? emphasised(verdict) : "A table or figures.")},
    ];
    return element("div.answers", null, bench.table(columns, papers, {caption: "Answers"}));
  }

  function tables(home) {
    fill(home, element("h1", null, "Tables"), all().length ? answers(all()) : element("p", null, "There is no table yet."));
  }

  function heading(entry) {
    const shipped = entry.shipped && "Shipped with the program: not of the runs on this page.";
    return [
      element("h1", null, entry.question || entry.title),
      element("p.soft", null, [entry.question && `${entry.title}.`, shipped].filter(Boolean).join(" ")),
      entry.verdict && element("p.answer", null, emphasised(entry.verdict)),
    ];
  }

  function paper(home, name) {
    const entry = find(name);
    const back = element("p.crumbs", null, element("a", {href: "#/tables"}, "All tables"));
    if (!entry) return fill(home, back, element("h1", null, "There is no such table"));
    return fill(home, back, heading(entry), later(bench.store.load("paper", entry.key), (data) => parts(entry, data)));
  }

  /* What answers the mouse, the picture, the table, caption and files; what shows the same twice is folded. */
  function parts(entry, data) {
    const image = () => element("img.figure", {src: data.picture, alt: data.caption || entry.title, loading: "lazy"});
    const picture = data.picture && element("figure", null, element("a", {href: data.files.PDF || data.picture}, image()));
    const links = Object.entries(data.files).map(([kind, href]) => [element("a", {href}, kind), " "]);
    const runs = (row) => bench.address.to(["runs"], {task: "all", view: "runs", folders: (data.folders[row] || []).join()});
    const rows = Object.keys(data.folders || {}).length ? {...data, named: data.header[0], link: runs} : data;
    const table = data.rows.length > 0 && bench.written(data.header, data.rows, entry.name === SUITE ? STANDING : rows);
    return [
      data.atlas && bench.atlas(data.atlas),
      data.chart && bench.chart(data.chart, {label: entry.title}),
      picture && (data.atlas || data.chart) ? details("The figure as in the paper", picture) : picture,
      data.command && copied(data.command, "Copy the command"),
      element("p.caption", null, data.caption),
      table && data.atlas ? details("The table, with intervals", table) : table,
      data.notes.length > 0 && details(`Notes and definitions (${data.notes.length})`, list(data.notes)),
      links.length > 0 && element("p.files", null, "Files: ", links),
    ];
  }

  Object.assign(bench, {overview, tables, paper});
})((window.implicitBench = window.implicitBench || {}));
