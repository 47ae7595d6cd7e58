/* The columns of the leaderboards: of methods, by their medians, and of runs. */
(function (bench) {
  "use strict";

  const {element} = bench.dom;
  const {number, count, seconds, date, label, MISSING} = bench.format;

  /* What of the state stands in the address: all but what is so without it. */
  function asked(state) {
    return {...state, task: state.task || "all", view: state.view === "methods" ? "" : state.view};
  }

  function methodColumns(state, metrics) {
    const linked = (row) =>
      bench.address.to(["runs"], {...asked(state), view: "runs", name: row.name, sort: "", order: "", page: ""});
    return [
      {key: "rank", label: "#", kind: "rank", cell: (row) => row.rank || element("span.soft", null, MISSING)},
      {
        key: "name",
        label: "Method",
        head: true,
        sortable: true,
        get: (row) => row.name.toLowerCase(),
        cell: (row) => element("a", {href: linked(row)}, row.name),
      },
      ...metrics.map((key, place) => methodMetric(key, place)),
      {
        key: "failed",
        label: "Failed",
        kind: "number",
        sortable: true,
        get: (row) => row.failed / row.places.length,
        cell: (row) =>
          element(`span${row.failed ? ".failed" : ".soft"}`, null, `${row.failed} of ${row.places.length}`),
      },
      {
        key: "covered",
        label: "Scenes",
        kind: "number",
        sortable: true,
        down: true,
        get: (row) => row.covered,
        cell: (row) => row.covered,
      },
      ...costs((row, key) => row[key], "median of ok runs", metrics.length === 0),
    ];
  }

  function methodMetric(key, place) {
    const metric = bench.runs.metrics[key];
    const shown = (value) =>
      Math.abs(value) === Infinity && value !== null
        ? element("span.failed", null, "failed")
        : number(value, metric.factor);
    return {
      key,
      label: label(metric.label),
      unit: "median",
      kind: "number",
      metric: true,
      sortable: true,
      first: place === 0 && metric.better !== "",
      down: metric.better === "higher",
      get: (row) => row[key],
      cell: (row) => shown(row[key]),
    };
  }

  function runColumns(state, metrics) {
    const runs = bench.runs;
    return [
      {key: "pick", label: "Compare", kind: "pick", cell: (place) => bench.picks.box(place)},
      {key: "picture", label: "Picture", kind: "thumb", cell: thumb},
      {
        key: "name",
        label: "Run",
        head: true,
        sortable: true,
        get: (place) => runs.text(place, "name").toLowerCase(),
        cell: named,
      },
      {key: "status", label: "Status", sortable: true, get: (place) => runs.text(place, "status"), cell: status},
      ...metrics.map((key, place) => runMetric(key, place)),
      ...costs((place, key) => runs.number(place, key), "total below", false),
      {
        key: "started",
        label: "Started",
        unit: "UTC",
        kind: "number",
        sortable: true,
        down: true,
        first: !metrics.length,
        get: (place) => runs.number(place, "started"),
        cell: (place) => element("span.soft", null, date(runs.number(place, "started"))),
      },
    ];
  }

  function costs(get, unit, first) {
    return [
      {
        key: "loop",
        label: "Loop",
        unit,
        kind: "number",
        sortable: true,
        first,
        get: (item) => get(item, "loop"),
        cell: (item) => [seconds(get(item, "loop")), element("small", null, seconds(get(item, "total")))],
      },
      {
        key: "values",
        label: "Field values",
        kind: "number",
        sortable: true,
        get: (item) => get(item, "values"),
        cell: (item) => count(get(item, "values")),
      },
    ];
  }

  function runMetric(key, place) {
    const metric = bench.runs.metrics[key];
    const ok = (run) => (bench.runs.text(run, "status") === "ok" ? metric.after[run] : null);
    const start = (run) =>
      metric.before && metric.before[run] !== null
        ? element("small", null, `from ${number(metric.before[run], metric.factor)}`)
        : null;
    return {
      key,
      label: label(metric.label),
      unit: metric.before ? "start below" : "",
      kind: "number",
      sortable: true,
      first: place === 0,
      down: metric.better === "higher",
      get: ok,
      cell: (run) => [number(metric.after[run], metric.factor), start(run)],
    };
  }

  function thumb(place) {
    const detail = bench.oneFile && bench.store.have("run", bench.runs.key(place));
    const held = bench.oneFile ? detail && detail.pictures.length && detail.pictures[0][1] : bench.runs.picture(place);
    return held
      ? element(
          "a",
          {href: bench.runs.link(place), tabindex: "-1", "aria-hidden": "true"},
          element("img", {src: held, alt: "", loading: "lazy", width: 60, height: 48}),
        )
      : element("span.soft", {"aria-hidden": "true"}, MISSING);
  }

  function named(place) {
    const runs = bench.runs;
    const about = [
      runs.text(place, "scene"),
      `seed ${runs.number(place, "seed") ?? MISSING}`,
      runs.text(place, "experiment"),
    ];
    const task = bench.address.read().query.task === "all" ? runs.text(place, "task") : "";
    return [
      element("a", {href: runs.link(place)}, runs.text(place, "name")),
      element("small", null, [task, ...about].filter(Boolean).join(" · ")),
      runs.reason(place) ? element("small.reason", {title: runs.reason(place)}, runs.reason(place)) : null,
    ];
  }

  function status(place) {
    const runs = bench.runs;
    return [bench.badge(runs.text(place, "status")), runs.reused(place) ? element("small", null, "reused") : null];
  }

  bench.columns = {methods: methodColumns, runs: runColumns, asked};
})((window.implicitBench = window.implicitBench || {}));
