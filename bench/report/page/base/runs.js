/* The runs as the page reads them: a text, a number or a metric of the run at a place of the list. */
(function (bench) {
  "use strict";

  const {decoded} = bench.store;

  function open() {
    const data = bench.store.have("list", "runs");
    const {texts, numbers, metrics} = data;
    for (const name of Object.keys(numbers)) numbers[name] = numbers[name].map(decoded);
    for (const metric of Object.values(metrics)) {
      metric.after = metric.after.map(decoded);
      metric.before = metric.before && metric.before.map(decoded);
    }
    const places = new Map(data.folder.map((folder, place) => [folder, place]));
    const keys = new Map(data.key.map((key, place) => [key, place]));
    const reused = new Set(data.reused);
    const found = [];

    /* The words of a run that a search looks through. */
    function words(place) {
      if (found[place] === undefined) {
        const parts = ["name", "task", "scene", "family", "renderer", "status", "experiment", "machine"];
        found[place] = [...parts.map((part) => text(place, part)), data.folder[place], data.reason[place]]
          .join(" ")
          .toLowerCase();
      }
      return found[place];
    }

    /* The folder, or the key of the run where a folder's name is no text that an address can have. */
    function name(place) {
      try {
        return encodeURIComponent(data.folder[place]) && data.folder[place];
      } catch {
        return data.key[place];
      }
    }

    const text = (place, column) => texts[column].values[texts[column].codes[place]];
    return {
      count: data.count,
      tasks: data.tasks,
      metrics,
      text,
      words,
      codes: (column) => texts[column].codes,
      values: (column) => texts[column].values,
      number: (place, column) => numbers[column][place],
      folder: (place) => data.folder[place],
      key: (place) => data.key[place],
      reason: (place) => data.reason[place],
      reused: (place) => reused.has(place),
      place: (name) => (places.has(name) ? places.get(name) : keys.get(name)),
      picture: (place) => text(place, "thumb") && data.address[place] + text(place, "thumb"),
      link: (place) => bench.address.to(["run", name(place)]),
      name,
      /* The name in one line for headings: name and scene, and the seed where it is known. */
      title: (place) => `${text(place, "name")}, ${text(place, "scene")}`,
    };
  }

  bench.openRuns = open;
})((window.implicitBench = window.implicitBench || {}));
