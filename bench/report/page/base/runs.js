/* The runs as the page reads them: a text, a number or a metric of the run at a place of the list; and its status. */
(function (bench) {
  "use strict";

  const {element} = bench.dom;
  const {decoded} = bench.store;
  const SEARCHED = ["name", "task", "scene", "family", "renderer", "status", "experiment", "machine"];
  const KINDS = {
    ok: ["good", "✓"],
    not_reached: ["warn", "↘"],
    timeout: ["warn", "◷"],
    oom: ["warn", "▦"],
    unsupported: ["mute", "–"],
    not_run: ["mute", "○"],
    killed: ["bad", "■"],
    nan: ["bad", "?"],
    diverged: ["bad", "↗"],
    empty: ["bad", "∅"],
    crashed: ["bad", "✕"],
    refused: ["bad", "✕"],
  };

  /* A status as a mark, a word and a colour: never by its colour alone. */
  function badge(status) {
    const [tone, mark] = KINDS[status];
    return element(`span.status.${tone}`, null, element("span", {"aria-hidden": "true"}, mark), status.replace("_", " "));
  }

  function openRuns() {
    const data = bench.store.have("list", "runs");
    const {texts, numbers, metrics} = data;
    for (const name of Object.keys(numbers)) numbers[name] = numbers[name].map(decoded);
    for (const metric of Object.values(metrics)) {
      metric.after = metric.after.map(decoded);
      metric.before = metric.before && metric.before.map(decoded);
    }
    const places = new Map([...data.key, ...data.folder].map((name, n) => [name, n % data.count]));
    const reused = new Set(data.reused);
    const found = [];
    const text = (place, column) => texts[column].values[texts[column].codes[place]];

    /* The words of a run that a search looks through. */
    function words(place) {
      const parts = () => [...SEARCHED.map((part) => text(place, part)), data.folder[place], data.reason[place]];
      return (found[place] = found[place] || parts().join(" ").toLowerCase());
    }

    /* The folder, or the key of the run where a folder's name is no text that an address can have. */
    function name(place) {
      try {
        return encodeURIComponent(data.folder[place]) && data.folder[place];
      } catch {
        return data.key[place];
      }
    }

    /* The details of a run: what it shares with others stands once in their script, and has numbers here. */
    function told({texts, runs}, place) {
      const run = runs[data.key[place]];
      return {
        ...run,
        settings: run.settings.flatMap((part) => texts[part]),
        environment: run.environment.map((row) => texts[row]),
        metrics: run.metrics.map(([name, before, after, words]) => [texts[name], before, after, texts[words]]),
        files: Object.fromEntries(texts[run.files].map((name) => [name, data.address[place] + name])),
        python: texts[run.python].replaceAll("\0", data.folder[place]),
      };
    }

    const {meshes} = bench.store.have("list", "about");
    const unmade = `Made for the newest ${meshes} runs: python -m bench.report meshes=all makes all.`;

    return {
      ...{count: data.count, tasks: data.tasks, metrics, text, words, name},
      codes: (column) => texts[column].codes,
      values: (column) => texts[column].values,
      number: (place, column) => numbers[column][place],
      folder: (place) => data.folder[place],
      reason: (place) => data.reason[place],
      reused: (place) => reused.has(place),
      place: (wanted) => places.get(wanted),
      detail: (place) => bench.store.load("run", data.key[place].slice(0, 2)).then((whole) => told(whole, place)),
      mesh: (place) => bench.store.load("mesh", data.key[place]).catch((error) => (meshes === null ? Promise.reject(error) : {none: unmade})),
      picture: (place) => text(place, "thumb") && data.address[place] + text(place, "thumb"),
      link: (place) => bench.address.to(["run", name(place)]),
      title: (place) => `${text(place, "name")}, ${text(place, "scene")}`,
    };
  }

  Object.assign(bench, {badge, openRuns});
})((window.implicitBench = window.implicitBench || {}));
