/* Leaderboards: the methods of a task, a table for each group that compares, or its runs, filtered, searched and sorted;
   all of it stands in the address. */
(function (bench) {
  "use strict";

  const {element, fill, soft, choice} = bench.dom;
  const {number, count, seconds, date, plural, label, MISSING} = bench.format;
  const {FILTERS, LINKED, SILENT} = bench.choose;
  const MAX_METRICS = 6;

  /* Fills a section with the board that the query asks for, and keeps it in step with its controls. */
  function board(home, query) {
    if (!bench.runs.count) {
      const example = element("code", null, "python -m bench task=completion renderer=dist");
      return fill(home, element("h2", {id: "board"}, "Runs"), element("p", null, "No run was read. Make one: ", example));
    }
    const state = {task: bench.runs.tasks[0].task, ...query, view: query.view === "runs" ? "runs" : "methods"};
    if (query.task === "all") state.task = "";
    const keep = () => bench.address.keep(["runs"], asked(state));
    const change = (changes) => {
      Object.assign(state, {page: ""}, changes);
      keep();
      show();
    };
    const views = choice("What a row is", {methods: "Methods", runs: "Runs"}, state.view, (view) => change({view, sort: "", order: ""}));
    const input = ({target}) => change({q: target.value});
    const search = element("input", {type: "search", placeholder: "Search names, scenes, reasons", "aria-label": "Search", input});
    const [filters, chips, found] = [element("div.picks"), element("div.chips"), element("div")];

    function show() {
      const focused = document.activeElement.dataset.column;
      const chosen = bench.choose.choose(bench.runs, state);
      if (search.value !== (state.q || "")) search.value = state.q || "";
      fill(filters, Object.keys(FILTERS).map((column) => filter(column, state, chosen.counts[column], change)));
      fill(chips, chipsOf(state, change));
      fill(found, chosen.indices.length ? rows(state, chosen.indices, keep) : element("p.empty", null, "No run fits. Take a filter away."));
      if (focused) filters.querySelector(`[data-column="${focused}"]`)?.focus(); // its list has been rebuilt
    }

    fill(home,
      element("h2", {id: "board"}, "Leaderboards"),
      element("nav.tabs", {"aria-label": "Tasks"}, tabs(state)),
      element("div.controls", null, views, search, filters, chips),
      found);
    show();
  }

  /* The part of the state that the address needs: all except defaults. */
  const asked = (state) => ({...state, task: state.task || "all", view: state.view === "methods" ? "" : state.view});

  function tabs(state) {
    const tasks = bench.runs.tasks.map(({task, count: n}) => [task, task.replace(/_/g, " "), n]);
    return [...tasks, ["", "all", bench.runs.count]].map(([task, name, n]) => {
      const href = bench.address.to(["runs"], {task: task || "all", view: task ? "" : "runs"});
      const current = task === state.task ? "page" : null;
      return element("a", {href, "aria-current": current}, name, element("small", null, n.toLocaleString("en")));
    });
  }

  /* A list of the values that a column has under the other filters. */
  function filter(column, state, counts, change) {
    const values = bench.runs.values(column);
    const known = [...counts].map(([code, n]) => [values[code], n]).filter(([value]) => value !== "").sort((a, b) => b[1] - a[1]);
    if (state[column] && !known.some(([value]) => value === state[column])) known.push([state[column], 0]);
    const options = known.map(([value, n]) => element("option", {value}, `${value} (${n.toLocaleString("en")})`));
    const pick = ({target}) => change({[column]: target.value});
    const all = element("option", {value: ""}, "all");
    const select = element("select", {"data-column": column, "aria-label": FILTERS[column], change: pick}, all, options);
    select.value = state[column] || "";
    return known.length > 1 || state[column] ? element("label.pick", null, FILTERS[column], select) : null;
  }

  /* The active filters, each with a button that removes it. */
  function chipsOf(state, change) {
    const set = [...LINKED, ...Object.keys(FILTERS), "q", "folders"].filter((column) => state[column]);
    const chip = (column) => {
      const text = column === "folders" ? plural(state.folders.split(",").length, "run") : state[column];
      const click = () => change({[column]: ""});
      return element("button.chip", {type: "button", "aria-label": `Remove the filter ${text}`, click}, `${text} ×`);
    };
    const clear = () => change(Object.fromEntries(set.map((column) => [column, ""])));
    return [set.map(chip), set.length > 1 && element("button.chip.plain", {type: "button", click: clear}, "Clear all")];
  }

  /* How many runs there are, whose machines their times are of, and the table. */
  function rows(state, indices, changed) {
    const {runs} = bench;
    const statuses = indices.map((index) => runs.text(index, "status"));
    const silent = statuses.filter((one) => SILENT.has(one)).length;
    const failed = statuses.filter((one) => one !== "ok").length - silent;
    const ended = failed ? `${failed.toLocaleString("en")} did not end ok` : silent ? "none failed" : "all ended ok";
    const unmade = silent ? `, ${silent.toLocaleString("en")} not run, killed or refused` : "";
    const of = indices.length < runs.count ? ` of ${runs.count.toLocaleString("en")}` : "";
    const summary = `${plural(indices.length, "run")}${of}, ${ended}${unmade}.`;
    const task = runs.tasks.find((each) => each.task === state.task);
    const known = (key) => indices.some((index) => runs.metrics[key].after[index] !== null);
    const metrics = (task ? task.metrics : []).filter(known).slice(0, MAX_METRICS);
    const boards = state.view === "methods" ? ofMethods(state, indices, metrics) : [ofRuns(state, indices, metrics)];
    const tables = boards.map(({title, columns, items, ...how}) =>
      [title && element("h3", null, title), bench.table(columns, items, {...how, caption: title || summary, state, changed, cards: true})]);
    return [element("p.count", {"aria-live": "polite"}, summary), machines(indices), element("div", {id: "board-list"}, tables)];
  }

  /* A table for each group of runs that compare. */
  function ofMethods(state, indices, metrics) {
    const ranks = metrics.length > 0 && bench.runs.metrics[metrics[0]].better !== "";
    const first = ranks ? metrics[0] : metrics.length ? "name" : "loop";
    return bench.choose.groups(bench.runs, indices).map(({scale, cells, indices: own}) => {
      const items = bench.choose.methods(bench.runs, own, metrics);
      const ordered = (all) => all.forEach((row, n) => (row.rank = ranks && cells ? n + 1 : null));
      const on = cells
        ? ` on the ${plural(cells, "scene")} (shape, view, seed, what is given) that all share`
        : items.length > 1 ? " without a scene in common: no ranks" : " alone";
      const title = `${scale ? `scale=${scale}: ` : ""}${plural(items.length, "method")}${on}`;
      return {columns: methodColumns(state, metrics), items, first, ordered, title};
    });
  }

  /* A column of numbers that sorts. */
  const numeric = (key, name, get, show, more) =>
    ({key, label: name, kind: "number", get, cell: (item) => show(get(item), item), ...more});

  function methodColumns(state, metrics) {
    const runsOf = (name) => bench.address.to(["runs"], {...asked(state), view: "runs", name, sort: "", order: "", page: ""});
    const linked = ({name}) => element("a", {href: runsOf(name)}, name);
    const share = (row) => element(`span${row.failed ? ".failed" : ".soft"}`, null, `${row.failed} of ${row.runs}`);
    const measured = (key) => {
      const {label: name, factor, better} = bench.runs.metrics[key];
      const show = (value) => (Math.abs(value) === Infinity ? element("span.failed", null, "failed") : number(value, factor));
      return numeric(key, label(name), (row) => row[key], show, {unit: "median", down: better === "higher"});
    };
    return [
      {key: "rank", label: "#", kind: "rank", cell: (row) => row.rank || soft(MISSING)},
      {key: "name", label: "Method", head: true, get: ({name}) => name.toLowerCase(), cell: linked},
      ...metrics.map(measured),
      numeric("failed", "Failed", (row) => row.failed / row.runs, (value, row) => share(row)),
      numeric("covered", "Scenes", (row) => row.covered, String, {down: true}),
      ...costs((row, key) => row[key], "median; whole run below"),
    ];
  }

  function ofRuns(state, indices, metrics) {
    const {runs} = bench;
    const measured = (key) => {
      const {label: name, factor, better, after, before} = runs.metrics[key];
      const ok = (index) => (runs.text(index, "status") === "ok" ? after[index] : null);
      const start = (index) => before && before[index] !== null && element("small", null, `from ${number(before[index], factor)}`);
      const show = (value, index) => [number(after[index], factor), start(index)];
      return numeric(key, label(name), ok, show, {unit: before && "start below", down: better === "higher"});
    };
    const text = (key, name, cell) => ({key, label: name, get: (index) => runs.text(index, key).toLowerCase(), cell});
    const reused = (index) => runs.reused(index) && element("small", null, "reused");
    const columns = [
      {key: "pick", label: "Compare", kind: "pick", cell: bench.pick},
      {key: "picture", label: "Picture", kind: "thumb", cell: thumb},
      {...text("name", "Run", (index) => named(index, state)), head: true},
      text("status", "Status", (index) => [bench.badge(runs.text(index, "status")), reused(index)]),
      ...metrics.map(measured),
      ...costs((index, key) => runs.number(index, key), "whole run below"),
      numeric("started", "Started", (index) => runs.number(index, "started"), (value) => soft(date(value)), {unit: "UTC", down: true}),
    ];
    return {columns, items: indices, first: metrics[0] || "started"};
  }

  const costs = (get, unit) => [
    numeric("loop", "Optimisation", (item) => get(item, "loop"),
      (value, item) => [seconds(value), element("small", null, seconds(get(item, "total")))], {unit}),
    numeric("cost", "Field evaluations", (item) => get(item, "cost"), count),
  ];

  function thumb(index) {
    const src = bench.runs.picture(index);
    if (!src) return element("span.soft", {"aria-hidden": "true"}, MISSING);
    const image = element("img", {src, alt: "", loading: "lazy", width: 60, height: 48});
    return element("a", {href: bench.runs.link(index), tabindex: "-1", "aria-hidden": "true"}, image);
  }

  function named(index, state) {
    const {runs} = bench;
    const seed = `seed ${runs.number(index, "seed") ?? MISSING}`;
    const [task, scene, experiment] = ["task", "scene", "experiment"].map((key) => runs.text(index, key));
    const scale = runs.values("scale").length > 1 && runs.text(index, "scale");
    const about = [state.task ? "" : task, scene, seed, experiment, scale && `scale=${scale}`];
    const reason = runs.reason(index);
    return [
      element("a", {href: runs.link(index)}, runs.text(index, "name")),
      element("small", null, about.filter(Boolean).join(" · ")),
      reason && element("small.reason", {title: reason}, reason),
    ];
  }

  /* A word on machines where the times that are shown are of several. */
  function machines(indices) {
    const timed = indices.filter((index) => bench.runs.number(index, "loop") !== null || bench.runs.number(index, "total") !== null);
    const counts = new Map();
    for (const machine of timed.map((index) => bench.runs.text(index, "machine")).filter(Boolean))
      counts.set(machine, (counts.get(machine) || 0) + 1);
    const sorted = [...counts].sort((a, b) => b[1] - a[1]);
    if (sorted.length < 2) return sorted.length ? element("p.soft", null, `Times of ${sorted[0][0]}.`) : null;
    return element("p.note", {id: "machines"},
      element("strong", null, "Times are of different machines or numbers of threads. "),
      `Choose one under Machine to compare seconds. ${sorted.map(([machine, n]) => `${machine}: ${plural(n, "run")}`).join("; ")}.`);
  }

  /* The leaderboards alone. */
  function leaderboards(home, query) {
    const boards = element("section", {"aria-labelledby": "board"});
    fill(home, element("h1.unseen", null, "Leaderboards"), boards);
    board(boards, query);
  }

  Object.assign(bench, {board, leaderboards});
})((window.implicitBench = window.implicitBench || {}));
