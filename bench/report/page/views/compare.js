/* Two runs side by side: settings that differ, metrics, costs, curves, meshes that turn together, pictures. */
(function (bench) {
  "use strict";

  const {element, fill, soft, section, details: fold, later, code} = bench.dom;
  const {number, count, seconds, size, label, MISSING} = bench.format;
  const SIDES = ["A", "B"];
  const MAX_NAMED_KEYS = 6;  // keys that are named in a line

  function compare(home, names) {
    const {runs} = bench;
    const indices = names.map(runs.indexOf);
    if (indices.length !== 2 || indices.includes(undefined)) {
      const link = element("a", {href: bench.address.to(["runs"], {view: "runs"})}, "list of runs");
      return fill(home, element("h1", null, "Compare two runs"), element("p", null, "Pick two in the ", link, "."));
    }
    const swapped = bench.address.to(["compare", ...indices.map(runs.name).reverse()]);
    return fill(home,
      element("p.crumbs", null, element("a", {href: "#/"}, "All results")),
      element("h1", null, "Two runs side by side"),
      element("div.two", null, indices.map(heading)),
      element("p", null, element("a.button", {href: swapped}, "Swap")),
      later(Promise.all(indices.map(runs.detail)), (details) => parts(indices, details)));
  }

  const mark = (n) => element(`b.${"ab"[n]}`, null, SIDES[n]);

  /* Both sides, each with its letter: on a phone they stand below each other. */
  const paired = (made) => element("div.two", null, made.map((each, n) => element("div", null, element("p", null, mark(n)), each)));

  function heading(index, n) {
    const {runs} = bench;
    const about = runs.reason(index) || `seed ${runs.number(index, "seed") ?? MISSING}`;
    return element("div.side", null,
      element("p", null, mark(n), element("a", {href: runs.link(index)}, runs.title(index))),
      element("p", null, bench.badge(runs.text(index, "status")), " ", soft(about)));
  }

  function parts(indices, details) {
    const turning = [];
    const named = details.map(({curve}, n) => ({name: `${SIDES[n]}: ${bench.runs.text(indices[n], "name")}`, curve}));
    return [
      warning(details),
      section("Metrics after the run", metrics(details)),
      section("Settings that differ", settings(details)),
      section("Costs", costs(indices, details)),
      section("Curves", bench.curves(named)),
      details.every(({files}) => files["mesh.ply"]) &&
        section("Meshes", paired(indices.map((index) => bench.mesh(index, turning)))),
      section("Pictures", pictures(details)),
    ];
  }

  /* A table with a column per side, and others. */
  function table(caption, rows, name, cell, kind, ...others) {
    const values = SIDES.map((side, n) => ({label: side, kind, cell: (row) => cell(row, n)}));
    return bench.table([{label: caption, head: true, cell: name}, ...values, ...others], rows, {caption});
  }

  const ratio = (get) => ({label: "B over A", kind: "number", cell: (row) => {
    const [a, b] = [get(row, 0), get(row, 1)];
    return typeof a === "number" && typeof b === "number" && a > 0 && Number.isFinite(b / a) ? number(b / a) : MISSING;
  }});

  /* The settings of each side, all keys, and those of which the two values are not the same text. */
  function differing(details) {
    const sides = details.map((detail) => new Map(detail.settings));
    const all = [...new Set(sides.flatMap((side) => [...side.keys()]))];
    return {sides, all, keys: all.filter((key) => sides[0].get(key) !== sides[1].get(key))};
  }

  /* That more than the renderer differs, so that the metrics may differ for another reason. */
  function warning(details) {
    const keys = differing(details).keys.filter((key) => key !== "label" && !/^renderer\b/.test(key));
    const shown = keys.slice(0, MAX_NAMED_KEYS).flatMap((key, n) => (n ? [", ", code(key)] : [code(key)]));
    const more = keys.length > MAX_NAMED_KEYS ? ` and ${keys.length - MAX_NAMED_KEYS} more` : "";
    return keys.length > 0 && element("p.note", null, "Not only the renderer differs: ", shown, `${more}. The metrics may differ for that reason.`);
  }

  function settings(details) {
    const {sides, all, keys} = differing(details);
    if (!keys.length) return element("p", null, `None: all ${all.length} settings are equal.`);
    const value = (key, n) => (sides[n].has(key) ? sides[n].get(key) : soft(MISSING));
    return [table("Setting", keys, code, value), element("p.soft", null, `${all.length - keys.length} others are equal.`)];
  }

  /* Those that tables show first, scaled as there. */
  function metrics(details) {
    const sides = details.map((detail) => new Map(detail.metrics.map((row) => [row[0], bench.store.decoded(row[2])])));
    const found = new Set(sides.flatMap((side) => [...side.keys()]));
    if (!found.size) return element("p.soft", null, "Neither measured anything.");
    const shown = new Map(Object.entries(bench.runs.metrics).filter(([key]) => found.has(key)));
    const value = (name, n) => sides[n].get(name) ?? null;
    const better = (name) => {
      const [a, b, {better: way} = {}] = [value(name, 0), value(name, 1), shown.get(name)];
      if (!way || typeof a !== "number" || typeof b !== "number" || a === b) return "";
      return mark(a < b === (way === "lower") ? 0 : 1);
    };
    const name = (key) => (shown.has(key) ? label(shown.get(key).label) : code(key));
    const cell = (key, n) => number(value(key, n), shown.has(key) ? shown.get(key).factor : 1);
    const made = (rows) => table("Metric", rows, name, cell, "number", ratio(value), {label: "Better", cell: better});
    const rest = [...found].filter((key) => !shown.has(key));
    const more = shown.size ? fold(`${rest.length} more, by their keys in the record`, made(rest)) : made(rest);
    return [shown.size > 0 && made([...shown.keys()]), rest.length > 0 && more];
  }

  function costs(indices, details) {
    const {runs} = bench;
    const rows = [
      ["Optimisation", (n) => runs.number(indices[n], "loop"), seconds],
      ["In all", (n) => runs.number(indices[n], "total"), seconds],
      ["Field evaluations (a gradient counts as two)", (n) => runs.number(indices[n], "cost"), count],
      ["Gradients of the field", (n) => runs.number(indices[n], "gradients"), count],
      ["Operations", (n) => details[n].costs.flops, count],
      ["Peak memory", (n) => details[n].costs.peak_memory_bytes, size],
    ];
    const [a, b] = indices.map((index) => runs.text(index, "machine") || "an unknown machine");
    return [
      table("Cost", rows, ([name]) => name, ([, get, show], n) => show(get(n)), "number", ratio(([, get], n) => get(n))),
      a !== b && element("p.note", null, `Seconds do not compare: A is of ${a}, B of ${b}.`),
    ];
  }

  function pictures(details) {
    const names = [...new Set(details.flatMap((detail) => detail.pictures.map(([name]) => name)))];
    if (!names.length) return element("p.soft", null, "Neither has pictures.");
    return names.map((name) => paired(details.map((detail) => {
      const found = detail.pictures.find(([own]) => own === name);
      return found ? bench.picture(found) : element("p.soft", null, `No ${name}.`);
    })));
  }

  bench.compare = compare;
})((window.implicitBench = window.implicitBench || {}));
