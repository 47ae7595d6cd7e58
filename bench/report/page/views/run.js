/* A run's own page: what was asked, what happened, numbers, costs, the mesh, pictures, and how to make and open it again. */
(function (bench) {
  "use strict";

  const {element, fill, copyButton, breakable} = bench.dom;
  const {number, count, seconds, size, date} = bench.format;

  function run(home, name) {
    const place = bench.runs.place(name);
    if (place === undefined) {
      fill(
        home,
        element("h1", null, "There is no such run"),
        element("p", null, `No run is called ${name}. `, element("a", {href: "#/runs"}, "All runs")),
      );
      return;
    }
    const runs = bench.runs;
    const body = element("div", null, element("p.soft", null, "Loading …"));
    const pick = element("label.pick-run", null, bench.picks.box(place), "Compare");
    fill(
      home,
      element(
        "p.crumbs",
        null,
        element("a", {href: "#/"}, "All results"),
        " / ",
        element(
          "a",
          {href: bench.address.to(["runs"], {task: runs.text(place, "task"), view: "runs"})},
          runs.text(place, "task"),
        ),
      ),
      element("h1", null, runs.title(place)),
      element(
        "p.about",
        null,
        bench.badge(runs.text(place, "status")),
        element(
          "span.soft",
          null,
          `seed ${runs.number(place, "seed") ?? "–"} · ${date(runs.number(place, "started"))} UTC · `,
        ),
        element("code.soft", null, runs.folder(place)),
        pick,
      ),
      body,
    );
    bench.store.load("run", runs.key(place)).then(
      (detail) => fill(body, parts(place, detail)),
      (error) => fill(body, element("p.note", null, error.message)),
    );
  }

  function parts(place, detail) {
    const [first, ...others] = detail.pictures;
    return [
      happened(place, detail),
      element(
        "div.columns",
        null,
        section("Asked", element("p", null, detail.asked)),
        section("Costs", costs(detail.costs)),
      ),
      detail.files["mesh.ply"] ? section("Mesh", bench.mesh.viewer(place)) : null,
      first
        ? section(
            "Pictures",
            element(
              "div.pictures",
              null,
              picture(first, true),
              others.map((each) => picture(each)),
            ),
          )
        : section("Pictures", element("p.soft", null, "This run left no picture.")),
      detail.curve ? section("Curve", bench.curves([{name: "run", curve: detail.curve}])) : null,
      section("Metrics, unscaled", metrics(detail.metrics)),
      section(
        "Make it again",
        code(detail.command, "Copy the command"),
        element("p.soft", null, "Configurations are code: read one that is not yours first. From Python:"),
        code(detail.again, "Copy the lines that make it again"),
      ),
      section("Open it in Python", code(detail.python, "Copy the lines that open it")),
      section(
        "Files",
        Object.keys(detail.files).length
          ? element(
              "p.files",
              null,
              Object.entries(detail.files).map(([name, link]) => [element("a", {href: link}, name), " "]),
            )
          : element("p.soft", null, "None."),
      ),
      element(
        "details",
        null,
        element("summary", null, `All ${detail.settings.length} settings`),
        facts(detail.settings),
      ),
      detail.environment.length
        ? element("details", null, element("summary", null, "Machine and versions"), facts(detail.environment))
        : null,
    ];
  }

  /* The status in words, the reason, what helps, and the notes. */
  function happened(place, {said, reason, notes, log}) {
    const ok = bench.runs.text(place, "status") === "ok";
    return element(
      `div.happened${ok ? ".ok" : ""}`,
      null,
      element(
        "p",
        null,
        element("strong", null, said.meaning),
        reason ? ` ${reason}` : ok ? "" : " No reason was recorded.",
      ),
      said.remedy ? element("p", null, element("b", null, "What helps: "), said.remedy) : null,
      notes.length
        ? element(
            "ul",
            null,
            notes.map((note) => element("li", null, note)),
          )
        : null,
      log.length
        ? element(
            "details",
            null,
            element("summary", null, `The last ${log.length === 1 ? "line" : `${log.length} lines`} of its log`),
            element("pre", null, log.join("\n")),
          )
        : null,
    );
  }

  const section = (title, ...children) => element("section", null, element("h2", null, title), children);

  function code(text, label) {
    return element("div.code", null, element("pre", {tabindex: 0}, text), copyButton(text, label));
  }

  function picture([name, link, alt], wide) {
    const shown = element("img", {src: link, alt: alt || name, loading: "lazy"});
    return element(
      `figure${wide ? ".wide-figure" : ""}`,
      null,
      bench.oneFile ? shown : element("a", {href: link}, shown),
      element("figcaption", null, element("b", null, name), alt ? ` ${alt}` : ""),
    );
  }

  function metrics(rows) {
    if (!rows.length) return element("p.soft", null, "This run measured nothing.");
    const columns = [
      {label: "Name", head: true, cell: ([name]) => element("code", null, breakable(name))},
      {label: "Before", kind: "number", cell: (row) => measured(row[1])},
      {label: "After", kind: "number", cell: (row) => measured(row[2])},
      {label: "Definition", cell: (row) => row[3] || element("span.soft", null, "No definition recorded.")},
    ];
    return element("div.wide.defined", null, bench.table.table(columns, rows, {caption: "Metrics before and after"}));
  }

  /* A metric; a whole number has no decimals. */
  const measured = (value) =>
    Number.isInteger(value) && Math.abs(value) < 1e6 ? String(value) : number(bench.store.decoded(value));

  /* A bar per phase, and what was counted. */
  function costs({phases, total, evaluations, flops, gemm_fraction, peak_memory_bytes}) {
    const known = phases.map(([label, spent, loop]) => [label, bench.store.decoded(spent), loop]);
    const most = Math.max(...known.map(([, spent]) => spent), 1e-9);
    const loop = known.filter((phase) => phase[2]).reduce((sum, [, spent]) => sum + spent, 0);
    const bars = known.map(([label, spent, own]) => {
      const bar = element(`span.bar${own ? ".own" : ""}`, {"aria-hidden": "true"});
      bar.style.width = `${Math.max(0.5, (100 * spent) / most)}%`;
      return element(
        "div.phase",
        null,
        element("span", null, label),
        element("span.track", null, bar),
        element("span.number", null, seconds(spent)),
      );
    });
    const counts = [
      ...evaluations.map(([name, value]) => [
        `evaluations, ${name.replace(/_/g, " ")}`,
        name === "per_ray" || name === "work_over_bound" ? number(value) : count(value),
      ]),
      ["floating-point operations", count(flops)],
      ["share of the machine's GEMM peak", number(gemm_fraction)],
      ["peak memory", size(peak_memory_bytes)],
    ].filter(([, value]) => value !== "–");
    return [
      known.length
        ? element("p", null, element("strong", null, seconds(loop)), " in the loop, ", seconds(total), " in all.")
        : element("p.soft", null, total === null ? "Nothing was timed." : `${seconds(total)} in all.`),
      element("div.phases", null, bars),
      facts(counts),
    ];
  }

  function facts(rows) {
    return element(
      "dl.facts",
      null,
      rows.map(([name, value]) => element("div", null, element("dt", null, name), element("dd", null, value))),
    );
  }

  bench.run = run;
  bench.runParts = {section, picture, facts};
})((window.implicitBench = window.implicitBench || {}));
