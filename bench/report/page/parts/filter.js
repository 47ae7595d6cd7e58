/* Chooses, counts and sorts runs: plain loops over columns, so that ten thousand runs take milliseconds. */
(function (bench) {
  "use strict";

  const FILTERS = {
    family: "Shapes",
    renderer: "Renderer",
    status: "Status",
    machine: "Machine",
    experiment: "Experiment",
  };
  const LINKED = ["name"]; // set by links alone, and shown as a word that can be taken away
  const COLUMNS = [...Object.keys(FILTERS), ...LINKED];

  /* The places of the runs that the query asks for, and of each filter the counts of its values under all others. */
  function choose(runs, query) {
    const wanted = [];
    for (const column of ["task", ...COLUMNS])
      if (query[column])
        wanted.push({column, codes: runs.codes(column), code: runs.values(column).indexOf(query[column])});
    const counts = Object.fromEntries(Object.keys(FILTERS).map((column) => [column, new Map()]));
    const words = (query.q || "").toLowerCase().split(/\s+/).filter(Boolean);
    const places = [];
    for (let place = 0; place < runs.count; place++) {
      let misses = 0;
      let missed = null;
      for (const {column, codes, code} of wanted)
        if (codes[place] !== code) {
          misses += 1;
          missed = column;
        }
      if (misses > 1 || !words.every((word) => runs.words(place).includes(word))) continue;
      if (misses === 0) places.push(place);
      for (const column of Object.keys(FILTERS))
        if (misses === 0 || missed === column) {
          const code = runs.codes(column)[place];
          counts[column].set(code, (counts[column].get(code) || 0) + 1);
        }
    }
    return {places, counts};
  }

  /* Sorts places by a column: {key, get, text}; missing values come last in either direction. */
  function sort(places, get, downwards) {
    const values = places.map((place) => [get(place), place]);
    const missing = (value) => value === null || value === undefined || value === "" || Number.isNaN(value);
    const sign = downwards ? -1 : 1;
    values.sort(([a, first], [b, second]) => {
      if (missing(a) || missing(b)) return missing(a) - missing(b) || first - second;
      return a < b ? -sign : a > b ? sign : first - second;
    });
    return values.map(([, place]) => place);
  }

  /* The median; of an even number the mean of the middle two; null of none. */
  function median(values) {
    if (!values.length) return null;
    const sorted = Float64Array.from(values).sort();
    const half = sorted.length >> 1;
    return sorted.length % 2 || sorted[half - 1] === sorted[half]
      ? sorted[half]
      : (sorted[half - 1] + sorted[half]) / 2;
  }

  /* A row per name: its runs, what they cover, its failures, and medians in which a run that failed is the worst. */
  function methods(runs, places, metrics) {
    const groups = new Map();
    const cells = new Set();
    for (const place of places) {
      const name = runs.text(place, "name");
      if (!groups.has(name)) groups.set(name, []);
      groups.get(name).push(place);
      cells.add(runs.codes("cell")[place]);
    }
    const rows = [...groups].map(([name, own]) => {
      const ok = own.filter((place) => runs.text(place, "status") === "ok");
      const covered = new Set(own.map((place) => runs.codes("cell")[place])).size;
      const row = {name, places: own, failed: own.length - ok.length, covered, complete: covered === cells.size};
      for (const key of metrics) row[key] = middle(runs, own, key);
      for (const key of ["loop", "total", "values"])
        row[key] = median(ok.map((place) => runs.number(place, key)).filter((value) => value !== null));
      return row;
    });
    return {rows, cells: cells.size};
  }

  function middle(runs, places, key) {
    const {better, after} = runs.metrics[key];
    const worst = better === "higher" ? -Infinity : Infinity;
    const known = places.map((place) => (runs.text(place, "status") === "ok" ? after[place] : null));
    const missing = (value) => value === null || Number.isNaN(value);
    if (known.every(missing))
      return places.some((place) => runs.text(place, "status") === "ok") || !better ? null : worst;
    return median(
      better ? known.map((value) => (missing(value) ? worst : value)) : known.filter((value) => !missing(value)),
    );
  }

  bench.filter = {FILTERS, LINKED, choose, sort, median, methods};
})((window.implicitBench = window.implicitBench || {}));
