/* The runs as the page reads them: texts, numbers and metrics by the index of a run; and the badge of a status. */
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
    const indices = new Map([...data.key, ...data.folder].map((name, n) => [name, n % data.count]));
    const reused = new Set(data.reused);
    const searchTexts = [];
    const text = (index, column) => texts[column].values[texts[column].codes[index]];

    /* The text of a run that a search reads. */
    function words(index) {
      const parts = () => [...SEARCHED.map((part) => text(index, part)), data.folder[index], data.reason[index]];
      return (searchTexts[index] = searchTexts[index] || parts().join(" ").toLowerCase());
    }

    /* The folder; or the key of the run if an address cannot contain the name of the folder. */
    function name(index) {
      try {
        return encodeURIComponent(data.folder[index]) && data.folder[index];
      } catch {
        return data.key[index];
      }
    }

    const {meshes} = bench.store.have("list", "about");
    const unmade = `Made for the newest ${meshes} runs: python -m bench.report meshes=all makes all.`;

    return {
      ...{count: data.count, tasks: data.tasks, metrics, text, words, name},
      codes: (column) => texts[column].codes,
      values: (column) => texts[column].values,
      number: (index, column) => numbers[column][index],
      folder: (index) => data.folder[index],
      reason: (index) => data.reason[index],
      reused: (index) => reused.has(index),
      indexOf: (name) => indices.get(name),
      detail: (index) => bench.store.load("run", data.key[index].slice(0, 2)).then((runs) => runs[data.key[index]]),
      mesh: (index) => bench.store.load("mesh", data.key[index]).catch((error) => (meshes === null ? Promise.reject(error) : {none: unmade})),
      picture: (index) => text(index, "thumb") && data.address[index] + text(index, "thumb"),
      link: (index) => bench.address.to(["run", name(index)]),
      title: (index) => `${text(index, "name")}, ${text(index, "scene")}`,
    };
  }

  Object.assign(bench, {badge, openRuns});
})((window.implicitBench = window.implicitBench || {}));
