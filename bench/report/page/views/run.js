/* A run's own page: what happened, the result, pictures, mesh and curve, what it cost, and how to make and open it again. */
(function (bench) {
  "use strict";

  const {element, fill, soft, section, details, list, facts, later, code, copied} = bench.dom;
  const {number, count, seconds, size, date, label} = bench.format;

  function run(home, name) {
    const {runs} = bench;
    const index = runs.indexOf(name);
    const back = element("a", {href: "#/runs"}, "All runs");
    if (index === undefined)
      return fill(home, element("h1", null, "There is no such run"), element("p", null, `No run is called ${name}. `, back));
    const task = runs.text(index, "task");
    const others = element("a", {href: bench.address.to(["runs"], {task, view: "runs"})}, task.replace(/_/g, " "));
    return fill(home,
      element("p.crumbs", null, element("a", {href: "#/"}, "All results"), " / ", others),
      element("h1", null, runs.title(index)),
      element("p.about", null,
        bench.badge(runs.text(index, "status")),
        soft(`seed ${runs.number(index, "seed") ?? "–"} · ${date(runs.number(index, "started"))} UTC`),
        element("label.pick-run", null, bench.pick(index), "Compare")),
      later(runs.detail(index), (detail) => parts(index, detail)));
  }

  function parts(index, detail) {
    const [first, ...others] = detail.pictures;
    const unlisted = !detail.metrics.some(([name]) => Object.hasOwn(bench.runs.metrics, name));
    const links = Object.entries(detail.files).map(([name, href]) => [element("a", {href}, name), " "]);
    return [
      element("p.asked", null, detail.asked),
      happened(index, detail),
      section("Result", element("div.two", null, unlisted ? null : result(detail.metrics), first && picture(first)),
        detail.metrics.length
          ? Object.assign(details(`All ${detail.metrics.length} metrics, with definitions`, recorded(detail.metrics)), {open: unlisted})
          : element("p.soft", null, "This run measured nothing.")),
      detail.rays && section("Most wrong pixels", rays(detail.rays)),
      detail.files["mesh.ply"] && section("Mesh", bench.mesh(index)),
      detail.curve && section("Curve", bench.curves([{name: "run", curve: detail.curve}])),
      others.length > 0 && section("Pictures", element("div.pictures", null, others.map(picture))),
      section("Costs", costs(detail.costs)),
      section("Make it again",
        copied(detail.command, "Copy the command"),
        element("p.soft", null, "Configurations are code: read one that is not yours first.")),
      section("Files", element("p.files", null, element("code", null, bench.runs.folder(index)), " ", links)),
      details(`All ${detail.settings.length} settings`, facts(detail.settings)),
      detail.environment.length > 0 && details("Machine and versions", facts(detail.environment)),
    ];
  }

  /* The status in words, the reason, what helps, and the notes. */
  function happened(index, {said, reason, notes, log}) {
    const ok = bench.runs.text(index, "status") === "ok";
    const lines = log.length === 1 ? "line" : `${log.length} lines`;
    return element(`div.happened${ok ? ".ok" : ""}`, null,
      element("p", null, element("strong", null, said.meaning), ` ${reason || (ok ? "" : "No reason was recorded.")}`),
      said.remedy && element("p", null, element("b", null, "What helps: "), said.remedy),
      notes.length > 0 && list(notes),
      log.length > 0 && details(`The last ${lines} of its log`, element("pre", null, log.join("\n"))));
  }

  /* The metrics that tables show, as they show them: scaled, with their unit. */
  function result(metrics) {
    const {runs} = bench;
    const found = new Map(metrics.map((row) => [row[0], row]));
    const rows = Object.values(runs.metrics).filter(({key}) => found.has(key));
    const value = ({key, factor}, column) => number(bench.store.decoded(found.get(key)[column]), factor);
    const [started, bounded] = [1, 4].map((column) => rows.some(({key}) => found.get(key)[column] !== null));
    const columns = [
      {label: "Metric", head: true, cell: (metric) => label(metric.label)},
      ...(started ? [{label: "Before", kind: "number", cell: (metric) => value(metric, 1)}] : []),
      {label: started ? "After" : "Value", kind: "number", cell: (metric) => value(metric, 2)},
      ...(bounded ? [{label: "Best possible", kind: "number", cell: (metric) => value(metric, 4)}] : []),
      {label: "Better", cell: (metric) => soft(metric.better || "–")},
    ];
    return bench.table(columns, rows, {caption: "Result"});
  }

  /* All metrics as the record has them: unscaled, with their definitions. */
  function recorded(metrics) {
    const shown = (value) => (Number.isInteger(value) && Math.abs(value) < 1e6 ? String(value) : number(bench.store.decoded(value)));
    const columns = [
      {label: "Name", head: true, cell: ([name]) => code(name)},
      {label: "Before", kind: "number", cell: (row) => shown(row[1])},
      {label: "After", kind: "number", cell: (row) => shown(row[2])},
      {label: "Definition", kind: "words.defined", cell: (row) => row[3] || soft("No definition recorded.")},
    ];
    const said = "Unscaled, in scene units: a shape lies in a sphere of radius 1.";
    return [element("p.soft", null, said), bench.table(columns, metrics, {caption: "All metrics"})];
  }

  /* The most wrong pixels: marks on the image and a list, which open the pictures of their rays; or the command. */
  function rays({command, map, rays: drawn}) {
    const command_text = copied(command, "Copy the command");
    if (!drawn.length)
      return [element("p.soft", null, "This command draws the rays of its 12 most wrong pixels, for this page:"), command_text];
    const open = ({picture: href, pixel}, kind, text) =>
      element(kind, {href, title: `pixel ${pixel}`, "aria-label": `The ray of pixel ${pixel}`}, text);
    const marks = drawn.map((ray, index) => {
      const mark = open(ray, "a.mark", String(index + 1));
      Object.assign(mark.style, {left: `${ray.left}%`, top: `${ray.top}%`});
      return mark;
    });
    const alt = "Hits: right in grey, missed in red, spurious in blue, at a wrong distance in orange";
    const image = map && element("figure.marked", null,
      element("div", null, element("img", {src: map, alt}), marks), element("figcaption", null, `${alt}. A number opens its ray.`));
    const items = drawn.map((ray) => element("li", null, open(ray, "a", `pixel ${ray.pixel}`), ` ${ray.text}`));
    return [element("div.two", null, element("ol.rays", null, items), image), details("The command that drew them", command_text)];
  }

  function picture([name, src, alt]) {
    const shown = element("img", {src, alt: alt || name, loading: "lazy"});
    const caption = element("figcaption", null, element("b", null, name), alt ? ` ${alt}` : "");
    return element("figure", null, element("a", {href: src}, shown), caption);
  }

  /* A bar per phase, and what was counted. */
  function costs({phases, total, evaluations, flops, gemm_fraction, peak_memory_bytes}) {
    const known = phases.map(([name, spent, own]) => [name, bench.store.decoded(spent), own]);
    const most = Math.max(...known.map(([, spent]) => spent), 1e-9);
    const spent = known.filter(([, , own]) => own).reduce((sum, [, each]) => sum + each, 0);
    const bars = known.map(([name, each, own]) => {
      const bar = element(`span.bar${own ? ".own" : ""}`, {"aria-hidden": "true"});
      bar.style.width = `${Math.max(0.5, (100 * each) / most)}%`;
      const time = element("span.number", null, seconds(each));
      return element("div.phase", null, element("span", null, name), element("span.track", null, bar), time);
    });
    const plain = ["per_ray", "work_over_bound"]; // no counts
    const counts = [
      ...evaluations.map(([name, value]) => [`evaluations, ${name.replace(/_/g, " ")}`, (plain.includes(name) ? number : count)(value)]),
      ...[["floating-point operations", count(flops)], ["share of the machine's GEMM peak", number(gemm_fraction)]],
      ["peak memory", size(peak_memory_bytes)],
    ];
    const untimed = total === null ? "Nothing was timed." : `${seconds(total)} in all.`;
    const timed = [element("strong", null, seconds(spent)), " of optimisation, ", seconds(total), " in all."];
    return [
      element("p", null, known.length ? timed : untimed),
      element("div.phases", null, bars),
      facts(counts.filter(([, value]) => value !== "–")),
    ];
  }

  Object.assign(bench, {run, picture});
})((window.implicitBench = window.implicitBench || {}));
