/* Chooses and counts runs: plain loops over columns, so that ten thousand runs take milliseconds. */
(function (bench) {
  "use strict";

  const FILTERS = {scale: "Scale", family: "Shapes", renderer: "Renderer", status: "Status", machine: "Machine", experiment: "Experiment"};
  const SILENT = new Set(["not_run", "killed", "refused"]); // these say nothing about a method
  const LINKED = ["name"]; // set only by links, and shown as a removable chip

  /* The indices of the runs that match the query, and for each filter the counts of its values under all other filters. */
  function choose(runs, query) {
    const columns = ["task", ...Object.keys(FILTERS), ...LINKED].filter((column) => query[column]);
    const wanted = columns.map((column) => [column, runs.codes(column), runs.values(column).indexOf(query[column])]);
    const counts = Object.fromEntries(Object.keys(FILTERS).map((column) => [column, new Map()]));
    const folders = query.folders && new Set(query.folders.split(","));
    const words = (query.q || "").toLowerCase().split(/\s+/).filter(Boolean);
    const indices = [];
    for (let index = 0; index < runs.count; index++) {
      const missed = wanted.filter(([, codes, code]) => codes[index] !== code);
      if (folders && !folders.has(runs.folder(index))) continue;
      if (missed.length > 1 || !words.every((word) => runs.words(index).includes(word))) continue;
      if (!missed.length) indices.push(index);
      for (const column of missed.length ? [missed[0][0]] : Object.keys(FILTERS)) {
        const code = runs.codes(column)[index];
        if (counts[column]) counts[column].set(code, (counts[column].get(code) || 0) + 1);
      }
    }
    return {indices, counts};
  }

  /* The median; for an even number the mean of the middle two; null without values. */
  function median(values) {
    const sorted = Float64Array.from(values).sort();
    const [low, high] = [sorted[(sorted.length - 1) >> 1], sorted[sorted.length >> 1]];
    return sorted.length ? (low === high ? low : (low + high) / 2) : null;
  }

  /* The indices by the value of a key. */
  function grouped(indices, key) {
    const groups = new Map();
    for (const index of indices) groups.has(key(index)) ? groups.get(key(index)).push(index) : groups.set(key(index), [index]);
    return groups;
  }

  /* Groups of comparable runs {scale, cells, indices}: of one scale, on the scenes that all of their methods have. The
     largest group comes first, and others follow until each method is in one. Single methods have no `cells`. */
  function groups(runs, indices) {
    const judged = indices.filter((index) => !SILENT.has(runs.text(index, "status")));
    return [...grouped(judged, (index) => runs.text(index, "scale"))].flatMap(([scale, own]) =>
      common(own, runs.codes("name"), runs.codes("cell")).map((group) => ({scale, ...group})));
  }

  function common(indices, names, cells) {
    const covers = new Map(); // the methods by scene
    for (const [cell, own] of grouped(indices, (index) => cells[index])) covers.set(cell, new Set(own.map((index) => names[index])));
    const sets = new Map([...covers.values()].map((methods) => [[...methods].sort().join(), methods]));
    const scenes = (methods) => [...covers].filter(([, names]) => [...methods].every((name) => names.has(name))).map(([cell]) => cell);
    const found = [...sets.values()].filter(({size}) => size > 1).map((methods) => ({methods, cells: new Set(scenes(methods))}));
    found.sort((a, b) => b.methods.size * b.cells.size - a.methods.size * a.cells.size);
    const shown = new Set();
    const kept = found.filter(({methods}) => {
      const more = [...methods].some((name) => !shown.has(name));
      for (const name of methods) shown.add(name);
      return more;
    });
    const groups = kept.map(({methods, cells: of}) =>
      ({cells: of.size, indices: indices.filter((index) => methods.has(names[index]) && of.has(cells[index]))}));
    const alone = indices.filter((index) => !shown.has(names[index]));
    return alone.length ? [...groups, {cells: 0, indices: alone}] : groups;
  }

  /* A row per name: runs, scenes, failures, and medians in which a failed run counts as worst. */
  function methods(runs, indices, metrics) {
    return [...grouped(indices, (index) => runs.text(index, "name"))].map(([name, own]) => {
      const ok = own.filter((index) => runs.text(index, "status") === "ok");
      const covered = new Set(own.map((index) => runs.codes("cell")[index])).size;
      const row = {name, runs: own.length, failed: own.length - ok.length, covered};
      for (const key of metrics) row[key] = middle(runs, own, key);
      for (const key of ["loop", "total", "cost"])
        row[key] = median(ok.map((index) => runs.number(index, key)).filter((value) => value !== null));
      return row;
    });
  }

  /* The median of a metric; null if no run that ended ok has it, or if none did and neither direction is better. */
  function middle(runs, indices, key) {
    const {better, after} = runs.metrics[key];
    const worst = better === "higher" ? -Infinity : Infinity;
    const ok = indices.filter((index) => runs.text(index, "status") === "ok");
    const values = ok.map((index) => after[index]).filter((value) => value !== null && !Number.isNaN(value));
    if (!values.length) return ok.length || !better ? null : worst;
    return median(better ? [...values, ...Array(indices.length - values.length).fill(worst)] : values);
  }

  bench.choose = {FILTERS, LINKED, SILENT, choose, groups, methods};
})((window.implicitBench = window.implicitBench || {}));
