/* A renderer's own page: its standing in each set, where it fails and and where others make more progress. */
(function (bench) {
  "use strict";

  const {element, fill, section, facts, later, copied} = bench.dom;
  const {plural} = bench.format;

  function renderer(home, row) {
    const suite = (bench.store.have("list", "papers") || []).find(({name}) => name === "suite");
    const loaded = Promise.all([bench.store.load("list", "renderers"), suite && bench.store.load("paper", suite.key)]);
    fill(home,
      element("p.crumbs", null, element("a", {href: "#/"}, "The suite")),
      element("h1", null, row),
      later(loaded, ([data, table]) => {
        const own = data.rows.find((each) => each.row === row);
        return own && table ? parts(own, data, table) : element("p", null, "The suite has no such renderer.");
      }));
  }

  function parts(own, data, table) {
    const cells = table.rows.find((each) => each.includes(own.row)) || [];
    const standing = table.header.map((name, n) => [name, cells[n]]).filter(([, text]) => text && text !== own.row);
    return [
      element("div.two", null, facts(standing), failure(own, data)),
      table.chart && bench.chart(table.chart, {label: `${own.row} in each set`, focus: own.row}),
      section("Where others make more progress", behind(own, data)),
      section("Run it", copied(own.command, "Copy the command")),
    ];
  }

  const named = ([of, problem, budget]) => `${of}: ${problem}, ${plural(budget, "unit")}`;

  /* How often it fails; the first failure, with its picture where its run is among these results. */
  function failure({failed, progress, runs}, {problems}) {
    const tried = progress.filter((each) => each !== null).length;
    if (!failed.length) return element("p", null, `It fails in none of ${plural(tried, "run")}.`);
    const [index, status, reason] = failed[0];
    const run = bench.runs.indexOf(runs[index]);
    return element("div", null,
      element("p", null, `It fails in ${failed.length} of ${plural(tried, "run")}. The first:`),
      element("p", null, bench.badge(status), ` ${named(problems[index])}: ${reason.replace(/\.?$/, ".")}`),
      run !== undefined && later(bench.runs.detail(run), ({pictures}) => {
        const found = pictures.find(([name]) => name === "failure.png") || pictures[0];
        return found && bench.picture(found);
      }));
  }

  /* Its progress at each problem and that of the best renderer: the largest gap first. */
  function behind(own, {problems, rows}) {
    const most = problems.map((_, index) => Math.max(...rows.map(({progress}) => progress[index] ?? 0)));
    const failed = new Map(own.failed.map(([index, said]) => [index, said]));
    const gap = (index) => most[index] - own.progress[index];
    const tried = problems.map((_, index) => index).filter((index) => own.progress[index] !== null);
    const indices = tried.filter((index) => gap(index) > 0).sort((a, b) => gap(b) - gap(a));
    const share = (key, label, get) =>
      ({key, label, kind: "number", unit: "% of the way to the best possible error", get, cell: (index) => (100 * get(index)).toFixed(0)});
    const columns = [
      {key: "problem", label: "Problem", head: true, get: (index) => named(problems[index]), cell: (index) => named(problems[index])},
      share("progress", "Progress", (index) => own.progress[index]),
      share("most", "Of the best", (index) => most[index]),
      {label: "Run", cell: (index) => [bench.badge(failed.get(index) || "ok"), " ", run(own.runs[index])]},
    ];
    if (!indices.length) return element("p", null, `No renderer makes more progress in any of ${plural(tried.length, "run")}.`);
    return bench.table(columns, indices, {caption: "Where others make more progress"});
  }

  function run(folder) {
    const index = bench.runs.indexOf(folder);
    return index !== undefined && element("a", {href: bench.runs.link(index)}, "open");
  }

  bench.renderer = renderer;
})((window.implicitBench = window.implicitBench || {}));
