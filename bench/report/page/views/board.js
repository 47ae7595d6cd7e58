/* Leaderboards: the methods of a task or its runs, filtered, searched and sorted; all of it stands in the address. */
(function (bench) {
  "use strict";

  const {element, fill} = bench.dom;
  const {plural} = bench.format;
  const ON_A_PAGE = 100;
  const MOST_METRICS = 6;

  /* Fills a section with the board that the query asks for, and keeps it in step with its controls. */
  function board(home, query) {
    const runs = bench.runs;
    const state = {task: runs.tasks[0].task, view: "methods", ...query};
    if (query.task === "all") state.task = "";
    const parts = {
      tasks: element("nav.tabs", {"aria-label": "Tasks"}),
      controls: element("div.controls"),
      found: element("div"),
    };
    fill(home, element("h2", {id: "board"}, "Leaderboards"), parts.tasks, parts.controls, parts.found);
    const change = (changes) => {
      Object.assign(state, {page: ""}, changes);
      bench.address.keep(["runs"], bench.columns.asked(state));
      show();
    };
    const show = () => {
      const chosen = bench.filter.choose(runs, state);
      fill(parts.tasks, tabs(state));
      controls(parts.controls, state, chosen, change);
      fill(parts.found, found(state, chosen, change));
    };
    show();
  }

  function tabs(state) {
    const runs = bench.runs;
    const entries = [
      ...runs.tasks.map(({task, count: n}) => [task, task.replace("_", " "), n]),
      ["", "all", runs.count],
    ];
    return entries.map(([task, name, n]) =>
      element(
        "a",
        {
          href: bench.address.to(["runs"], {task: task || "all", view: task ? "" : "runs"}),
          "aria-current": task === state.task ? "page" : null,
        },
        name,
        element("small", null, n.toLocaleString("en")),
      ),
    );
  }

  /* Controls are made once; what they offer follows from the other filters. */
  function controls(home, state, chosen, change) {
    if (!home.childElementCount) {
      const search = element("input", {
        type: "search",
        placeholder: "Search names, scenes, reasons",
        "aria-label": "Search",
        value: state.q || "",
        input: (event) => change({q: event.target.value}),
      });
      const selects = Object.entries(bench.filter.FILTERS).map(([column, name]) =>
        element(
          "label.pick",
          null,
          name,
          element("select", {
            "data-column": column,
            "aria-label": name,
            change: (event) => change({[column]: event.target.value}),
          }),
        ),
      );
      const views = ["methods", "runs"].map((view) =>
        element(
          "button",
          {type: "button", "data-view": view, click: () => change({view, sort: "", order: ""})},
          view === "methods" ? "Methods" : "Runs",
        ),
      );
      const sorts = element(
        "label.pick.narrow",
        null,
        "Sort by",
        element("select", {
          "data-column": "sort",
          "aria-label": "Sort by",
          change: (event) => change({sort: event.target.value, order: ""}),
        }),
      );
      home.append(
        element("div.switch", {role: "group", "aria-label": "What a row is"}, views),
        search,
        element("div.picks", null, selects, sorts),
        element("div.chips"),
      );
    }
    for (const button of home.querySelectorAll("[data-view]"))
      button.setAttribute("aria-pressed", String(button.dataset.view === state.view));
    for (const column of Object.keys(bench.filter.FILTERS)) offer(home, column, state, chosen.counts[column]);
    const sort = home.querySelector('[data-column="sort"]');
    const options = columnsOf(state, chosen).filter((column) => column.sortable);
    fill(
      sort,
      options.map((column) => element("option", {value: column.key}, column.label)),
    );
    sort.value = orderOf(state, options).key;
    chips(home.querySelector(".chips"), state, change);
  }

  function offer(home, column, state, counts) {
    const select = home.querySelector(`[data-column="${column}"]`);
    const values = bench.runs.values(column);
    const known = [...counts].filter(([code]) => values[code] !== "").sort((a, b) => b[1] - a[1]);
    const options = known.map(([code, n]) =>
      element("option", {value: values[code]}, `${values[code]} (${n.toLocaleString("en")})`),
    );
    if (state[column] && !known.some(([code]) => values[code] === state[column]))
      options.push(element("option", {value: state[column]}, `${state[column]} (0)`));
    fill(select, element("option", {value: ""}, "all"), options);
    select.value = state[column] || "";
    select.parentElement.hidden = options.length < 2 && !state[column];
  }

  /* The filters that are set, each with a button that takes it away. */
  function chips(home, state, change) {
    const set = [...bench.filter.LINKED, ...Object.keys(bench.filter.FILTERS), "q"].filter((column) => state[column]);
    const clear = Object.fromEntries(set.map((column) => [column, ""]));
    fill(
      home,
      set.map((column) =>
        element(
          "button.chip",
          {type: "button", "aria-label": `Remove the filter ${state[column]}`, click: () => change({[column]: ""})},
          state[column],
          element("span", {"aria-hidden": "true"}, " ×"),
        ),
      ),
      set.length > 1 ? element("button.chip.plain", {type: "button", click: () => change(clear)}, "Clear all") : null,
    );
    const search = home.parentElement.querySelector("input[type=search]");
    if (search.value !== (state.q || "")) search.value = state.q || "";
  }

  function found(state, chosen, change) {
    const runs = bench.runs;
    const {places} = chosen;
    if (!places.length) return element("p.empty", null, "No run fits. Take a filter away.");
    const failed = places.filter((place) => runs.text(place, "status") !== "ok").length;
    const said =
      `${plural(places.length, "run")}${places.length < runs.count ? ` of ${runs.count.toLocaleString("en")}` : ""}, ` +
      (failed ? `${failed.toLocaleString("en")} did not end ok` : "all ended ok");
    const columns = columnsOf(state, chosen);
    const order = orderOf(state, columns);
    const sorted = (key) => {
      change({sort: key, order: order.key !== key ? "" : order.down ? "up" : "down"});
      document.querySelector(`#board-list [data-key="${CSS.escape(key)}"]`).focus();
    };
    const shown = state.view === "methods" ? ofMethods(chosen, columns, order) : ofRuns(state, places, columns, order);
    return [
      element("p.count", {"aria-live": "polite"}, said, shown.said),
      machines(places),
      element("div.wide", {id: "board-list"}, bench.table.table(columns, shown.items, {order, sorted, caption: said})),
      shown.pages > 1 ? pager(Number(state.page || 1), shown.pages, change) : null,
    ];
  }

  /* The order of the query, or by the first metric with the best on top. */
  function orderOf(state, columns) {
    const column =
      columns.find(({key}) => key === state.sort) ||
      columns.find(({first}) => first) ||
      columns.find(({sortable}) => sortable); // by name, where no metric has a better direction
    const down = state.sort === column.key && state.order ? state.order === "down" : Boolean(column.down);
    return {key: column.key, down};
  }

  function columnsOf(state, chosen) {
    const task = bench.runs.tasks.find((each) => each.task === state.task);
    const known = (key) => chosen.places.some((place) => bench.runs.metrics[key].after[place] !== null);
    const metrics = task ? task.metrics.filter(known).slice(0, MOST_METRICS) : [];
    return state.view === "methods" ? bench.columns.methods(state, metrics) : bench.columns.runs(state, metrics);
  }

  function ofMethods(chosen, columns, order) {
    const metrics = columns.filter(({metric}) => metric).map(({key}) => key);
    const {rows, cells} = bench.filter.methods(bench.runs, chosen.places, metrics);
    const get = columns.find(({key}) => key === order.key).get;
    const places = bench.filter.sort(
      rows.map((_, place) => place),
      (place) => get(rows[place]),
      order.down,
    );
    const sorted = places.map((place) => rows[place]);
    const whole = sorted.filter((row) => row.complete);
    const ranked = columns.some(({first}) => first);
    whole.forEach((row, place) => (row.rank = ranked ? place + 1 : null));
    const part = sorted.length - whole.length;
    const covers = cells > 1 ? `; ${plural(cells, "scene")} (shape, view, seed and what is given)` : "";
    const unlike =
      part && sorted.length > 1
        ? `. Medians of ${plural(part, "method")} are over other scenes: only methods with all ` +
          `${cells.toLocaleString("en")} have a rank`
        : "";
    return {items: sorted, pages: 1, said: `${covers}${unlike}.`};
  }

  function ofRuns(state, places, columns, order) {
    const get = columns.find(({key}) => key === order.key).get;
    const sorted = bench.filter.sort(places, get, order.down);
    const pages = Math.ceil(sorted.length / ON_A_PAGE);
    const page = Math.min(Math.max(1, Number(state.page) || 1), pages);
    return {items: sorted.slice((page - 1) * ON_A_PAGE, page * ON_A_PAGE), pages, said: "."};
  }

  /* A word on machines where the times that are shown are of several. */
  function machines(places) {
    const runs = bench.runs;
    const counts = new Map();
    for (const place of places) {
      const machine = runs.text(place, "machine");
      if (machine && (runs.number(place, "loop") !== null || runs.number(place, "total") !== null))
        counts.set(machine, (counts.get(machine) || 0) + 1);
    }
    if (counts.size < 2)
      return counts.size ? element("p.soft.machine", null, `Times of ${[...counts.keys()][0]}.`) : null;
    const list = [...counts]
      .sort((a, b) => b[1] - a[1])
      .map(([machine, n]) => `${machine}: ${plural(n, "run")}`)
      .join("; ");
    return element(
      "p.note",
      {id: "machines"},
      element("strong", null, "Times are of different machines or numbers of threads. "),
      `Choose one under Machine to compare seconds. ${list}.`,
    );
  }

  function pager(page, pages, change) {
    const go = (to) => {
      change({page: to === 1 ? "" : String(to)});
      document.getElementById("board").scrollIntoView();
    };
    const button = (to, name) =>
      element("button", {type: "button", disabled: to < 1 || to > pages, click: () => go(to)}, name);
    return element(
      "nav.pager",
      {"aria-label": "Pages of the list"},
      button(1, "« First"),
      button(page - 1, "‹ Previous"),
      element("span", null, `Page ${page} of ${pages.toLocaleString("en")}`),
      button(page + 1, "Next ›"),
      button(pages, "Last »"),
    );
  }

  bench.board = board;
})((window.implicitBench = window.implicitBench || {}));
