/* Chooses and counts runs: plain loops over columns, so that ten thousand runs take milliseconds. */
(function (bench) {
  "use strict";

  const FILTERS = {scale: "Scale", family: "Shapes", renderer: "Renderer", status: "Status", machine: "Machine", experiment: "Experiment"};
  const SILENT = new Set(["not_run", "killed", "refused"]); // say nothing of a method
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

  /* The places of each value of a key. */
  function grouped(places, key) {
    const groups = new Map();
    for (const place of places) groups.has(key(place)) ? groups.get(key(place)).push(place) : groups.set(key(place), [place]);
    return groups;
  }

  /* The runs that compare, {scale, cells, places}: of one scale and of the scenes that all of their methods have. The group
     with the most comes first, and others follow until each method is in one; those alone have no `cells`. */
  function groups(runs, places) {
    const judged = places.filter((place) => !SILENT.has(runs.text(place, "status")));
    return [...grouped(judged, (place) => runs.text(place, "scale"))].flatMap(([scale, own]) =>
      common(own, runs.codes("name"), runs.codes("cell")).map((group) => ({scale, ...group})));
  }

  function common(places, names, cells) {
    const covers = new Map(); // of each scene, its methods
    for (const [cell, own] of grouped(places, (place) => cells[place])) covers.set(cell, new Set(own.map((place) => names[place])));
    const sets = new Map([...covers.values()].map((methods) => [[...methods].sort().join(), methods]));
    const scenes = (methods) => [...covers].filter(([, own]) => [...methods].every((one) => own.has(one))).map(([cell]) => cell);
    const found = [...sets.values()].filter(({size}) => size > 1).map((methods) => ({methods, cells: new Set(scenes(methods))}));
    found.sort((a, b) => b.methods.size * b.cells.size - a.methods.size * a.cells.size);
    const shown = new Set();
    const kept = found.filter(({methods}) => {
      const more = [...methods].some((one) => !shown.has(one));
      for (const one of methods) shown.add(one);
      return more;
    });
    const groups = kept.map(({methods, cells: of}) =>
      ({cells: of.size, places: places.filter((place) => methods.has(names[place]) && of.has(cells[place]))}));
    const alone = places.filter((place) => !shown.has(names[place]));
    return alone.length ? [...groups, {cells: 0, places: alone}] : groups;
  }

  /* A row per name: its runs, what they cover, its failures, and medians in which a run that failed is the worst. */
  function methods(runs, places, metrics) {
    return [...grouped(places, (place) => runs.text(place, "name"))].map(([name, own]) => {
      const ok = own.filter((place) => runs.text(place, "status") === "ok");
      const covered = new Set(own.map((place) => runs.codes("cell")[place])).size;
      const row = {name, runs: own.length, failed: own.length - ok.length, covered};
      for (const key of metrics) row[key] = middle(runs, own, key);
      for (const key of ["loop", "total", "values"])
        row[key] = median(ok.map((place) => runs.number(place, key)).filter((value) => value !== null));
      return row;
    });
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

  bench.choose = {FILTERS, LINKED, SILENT, choose, groups, methods};
})((window.implicitBench = window.implicitBench || {}));
