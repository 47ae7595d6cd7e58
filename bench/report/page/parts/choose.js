/* Chooses and counts runs: plain loops over columns, so that ten thousand runs take milliseconds. */
(function (bench) {
  "use strict";

  const FILTERS = {family: "Shapes", renderer: "Renderer", status: "Status", machine: "Machine", experiment: "Experiment"};
  const LINKED = ["name"]; // set by links alone, and shown as a word that can be taken away

  /* The places of the runs that the query asks for, and of each filter the counts of its values under all others. */
  function choose(runs, query) {
    const columns = ["task", ...Object.keys(FILTERS), ...LINKED].filter((column) => query[column]);
    const wanted = columns.map((column) => [column, runs.codes(column), runs.values(column).indexOf(query[column])]);
    const counts = Object.fromEntries(Object.keys(FILTERS).map((column) => [column, new Map()]));
    const words = (query.q || "").toLowerCase().split(/\s+/).filter(Boolean);
    const places = [];
    for (let place = 0; place < runs.count; place++) {
      const missed = wanted.filter(([, codes, code]) => codes[place] !== code);
      if (missed.length > 1 || !words.every((word) => runs.words(place).includes(word))) continue;
      if (!missed.length) places.push(place);
      for (const column of missed.length ? [missed[0][0]] : Object.keys(FILTERS)) {
        const code = runs.codes(column)[place];
        if (counts[column]) counts[column].set(code, (counts[column].get(code) || 0) + 1);
      }
    }
    return {places, counts};
  }

  /* The median; of an even number the mean of the middle two; null of none. */
  function median(values) {
    const sorted = Float64Array.from(values).sort();
    const [low, high] = [sorted[(sorted.length - 1) >> 1], sorted[sorted.length >> 1]];
    return sorted.length ? (low === high ? low : (low + high) / 2) : null;
  }

  /* A row per name: its runs, what they cover, its failures, and medians in which a run that failed is the worst. */
  function methods(runs, places, metrics) {
    const groups = new Map();
    for (const place of places) {
      const name = runs.text(place, "name");
      if (!groups.has(name)) groups.set(name, []);
      groups.get(name).push(place);
    }
    const covered = (some) => new Set(some.map((place) => runs.codes("cell")[place])).size;
    const cells = covered(places);
    const rows = [...groups].map(([name, own]) => {
      const ok = own.filter((place) => runs.text(place, "status") === "ok");
      const row = {name, runs: own.length, failed: own.length - ok.length, covered: covered(own)};
      row.complete = row.covered === cells;
      for (const key of metrics) row[key] = middle(runs, own, key);
      for (const key of ["loop", "total", "values"])
        row[key] = median(ok.map((place) => runs.number(place, key)).filter((value) => value !== null));
      return row;
    });
    return {rows, cells};
  }

  /* The median of a metric; null where no run that ended ok has it, or where none did and neither direction is better. */
  function middle(runs, places, key) {
    const {better, after} = runs.metrics[key];
    const worst = better === "higher" ? -Infinity : Infinity;
    const ok = places.filter((place) => runs.text(place, "status") === "ok");
    const known = ok.map((place) => after[place]).filter((value) => value !== null && !Number.isNaN(value));
    if (!known.length) return ok.length || !better ? null : worst;
    return median(better ? [...known, ...Array(places.length - known.length).fill(worst)] : known);
  }

  bench.choose = {FILTERS, LINKED, choose, methods};
})((window.implicitBench = window.implicitBench || {}));
