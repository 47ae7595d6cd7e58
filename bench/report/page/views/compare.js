/* Two runs side by side: settings that differ, metrics, costs, curves, meshes that turn together, pictures. */
(function (bench) {
  "use strict";

  const {element, fill} = bench.dom;
  const {number, count, seconds} = bench.format;

  function compare(home, names) {
    const places = names.map((name) => bench.runs.place(name));
    if (places.length !== 2 || places.includes(undefined)) {
      fill(
        home,
        element("h1", null, "Compare two runs"),
        element(
          "p",
          null,
          "Pick two in the ",
          element("a", {href: bench.address.to(["runs"], {view: "runs"})}, "list of runs"),
          ".",
        ),
      );
      return;
    }
    const body = element("div", null, element("p.soft", null, "Loading …"));
    const swapped = bench.address.to(["compare", ...places.map(bench.runs.name).reverse()]);
    fill(
      home,
      element("p.crumbs", null, element("a", {href: "#/"}, "All results")),
      element("h1", null, "Two runs side by side"),
      element("div.two", null, places.map(heading)),
      element("p.swap", null, element("a.button", {href: swapped}, "Swap")),
      body,
    );
    Promise.all(places.map((place) => bench.store.load("run", bench.runs.key(place)))).then(
      (details) => fill(body, parts(places, details)),
      (error) => fill(body, element("p.note", null, error.message)),
    );
  }

  function heading(place, number) {
    const runs = bench.runs;
    return element(
      "div.side",
      null,
      element(
        "p",
        null,
        element(`b.${"ab"[number]}`, null, "AB"[number]),
        element("a", {href: runs.link(place)}, runs.title(place)),
      ),
      element(
        "p",
        null,
        bench.badge(runs.text(place, "status")),
        element("span.soft", null, runs.reason(place) || `seed ${runs.number(place, "seed") ?? "–"}`),
      ),
    );
  }

  function parts(places, details) {
    const {section} = bench.runParts;
    const meshes = details.every((detail) => detail.files["mesh.ply"]);
    const shared = bench.mesh.view();
    return [
      section("Settings that differ", settings(details)),
      section("Metrics after the run", metrics(details)),
      section("Costs", costs(places, details)),
      section(
        "Curves",
        bench.curves(
          details.map((detail, n) => ({
            name: `${"AB"[n]}: ${bench.runs.text(places[n], "name")}`,
            curve: detail.curve,
          })),
        ),
      ),
      meshes
        ? section(
            "Meshes",
            element(
              "div.two",
              null,
              places.map((place) => bench.mesh.viewer(place, shared)),
            ),
          )
        : null,
      section("Pictures", pictures(details)),
    ];
  }

  /* The rows of which the two values are not the same text. */
  function settings([first, second]) {
    const others = new Map(second.settings);
    const own = new Map(first.settings);
    const keys = [...new Set([...own.keys(), ...others.keys()])].filter((key) => own.get(key) !== others.get(key));
    const same = new Set([...own.keys(), ...others.keys()]).size - keys.length;
    if (!keys.length) return element("p", null, `None: all ${same} settings are equal.`);
    const value = (map, key) => (map.has(key) ? map.get(key) : element("span.soft", null, "–"));
    const columns = [
      {label: "Setting", head: true, cell: (key) => element("code", null, bench.dom.breakable(key))},
      {label: "A", cell: (key) => value(own, key)},
      {label: "B", cell: (key) => value(others, key)},
    ];
    return [
      element("div.wide", null, bench.table.table(columns, keys, {caption: "Settings that differ"})),
      element("p.soft", null, `${same} others are equal.`),
    ];
  }

  function metrics([first, second]) {
    const others = new Map(second.metrics.map((row) => [row[0], row]));
    const own = new Map(first.metrics.map((row) => [row[0], row]));
    const names = [...new Set([...own.keys(), ...others.keys()])];
    if (!names.length) return element("p.soft", null, "Neither measured anything.");
    const value = (map, name) => (map.has(name) ? bench.store.decoded(map.get(name)[2]) : null);
    const better = (name) => {
      const known = bench.runs.metrics[name];
      const [a, b] = [value(own, name), value(others, name)];
      if (!known || !known.better || typeof a !== "number" || typeof b !== "number" || a === b) return "";
      return a < b === (known.better === "lower") ? "A" : "B";
    };
    const ratio = (name) => {
      const [a, b] = [value(own, name), value(others, name)];
      return typeof a === "number" && typeof b === "number" && a > 0 && Number.isFinite(b / a) ? number(b / a) : "–";
    };
    const columns = [
      {label: "Metric", head: true, cell: (name) => element("code", null, bench.dom.breakable(name))},
      {label: "A", kind: "number", cell: (name) => number(value(own, name))},
      {label: "B", kind: "number", cell: (name) => number(value(others, name))},
      {label: "B over A", kind: "number", cell: ratio},
      {
        label: "Better",
        cell: (name) => (better(name) ? element(`b.${better(name).toLowerCase()}`, null, better(name)) : ""),
      },
    ];
    return element("div.wide", null, bench.table.table(columns, names, {caption: "Metrics of both"}));
  }

  function costs(places, details) {
    const runs = bench.runs;
    const rows = [
      ["Loop", (n) => runs.number(places[n], "loop"), seconds],
      ["In all", (n) => runs.number(places[n], "total"), seconds],
      ["Field values", (n) => runs.number(places[n], "values"), count],
      ["Gradients of the field", (n) => runs.number(places[n], "gradients"), count],
      ["Operations", (n) => details[n].costs.flops, count],
      ["Peak memory", (n) => details[n].costs.peak_memory_bytes, bench.format.size],
    ];
    const machines = places.map((place) => runs.text(place, "machine"));
    const columns = [
      {label: "Cost", head: true, cell: ([label]) => label},
      ...["A", "B"].map((side, n) => ({label: side, kind: "number", cell: ([, get, show]) => show(get(n))})),
      {label: "B over A", kind: "number", cell: ([, get]) => (get(0) && get(1) ? number(get(1) / get(0)) : "–")},
    ];
    return [
      element("div.wide", null, bench.table.table(columns, rows, {caption: "Costs of both"})),
      machines[0] !== machines[1]
        ? element(
            "p.note",
            null,
            `Seconds do not compare: A is of ${machines[0] || "an unknown machine"}, B of ${machines[1] || "an unknown machine"}.`,
          )
        : null,
    ];
  }

  function pictures(details) {
    const names = [...new Set(details.flatMap((detail) => detail.pictures.map(([name]) => name)))];
    if (!names.length) return element("p.soft", null, "Neither has pictures.");
    return names.map((name) =>
      element(
        "div.two",
        null,
        details.map((detail) => {
          const found = detail.pictures.find(([own]) => own === name);
          return found ? bench.runParts.picture(found) : element("p.soft", null, `No ${name}.`);
        }),
      ),
    );
  }

  bench.compare = compare;
})((window.implicitBench = window.implicitBench || {}));
