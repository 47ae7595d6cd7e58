/* Keeps the data of scripts, and loads more by script elements, the only way for a page that was opened from a file. */
(function (bench) {
  "use strict";

  const FOLDER = "page/data";
  const NON_FINITE = {inf: Infinity, "-inf": -Infinity, nan: NaN};
  const received = new Map();
  const waiting = new Map();

  /* Called by the scripts of data. */
  function receive(kind, key, data) {
    received.set(`${kind}/${key}`, data);
    if (waiting.has(`${kind}/${key}`)) waiting.get(`${kind}/${key}`).resolve(data);
  }

  const have = (kind, key) => received.get(`${kind}/${key}`);

  /* A promise of the data of a kind and key; rejected with a message if its file is missing. */
  function load(kind, key) {
    const name = `${kind}/${key}`;
    if (received.has(name)) return Promise.resolve(received.get(name));
    if (!/^[a-z]+\/[A-Za-z0-9_-]+$/.test(name)) return Promise.reject(new Error(`${name} is no name of data.`));
    if (!waiting.has(name)) {
      const waits = {};
      waits.promise = new Promise((resolve, reject) => Object.assign(waits, {resolve, reject}));
      waiting.set(name, waits);
      script(`${FOLDER}/${name}.js`).catch(() => {
        waiting.delete(name);
        waits.reject(new Error(`${FOLDER}/${name}.js is not there: python -m bench.report writes it.`));
      });
    }
    return waiting.get(name).promise;
  }

  const script = (src) =>
    new Promise((onload, onerror) =>
      document.head.append(Object.assign(document.createElement("script"), {src, onload, onerror})));

  let library = null;

  /* A promise of Plotly, which is loaded when a chart or mesh first needs it. */
  function plotly() {
    if (window.Plotly) return Promise.resolve(window.Plotly);
    library = library || script("page/plotly.min.js").then(() => window.Plotly);
    return library;
  }

  /* A number; scripts write infinite numbers and nan as words, and missing numbers as null. */
  const decoded = (value) => (typeof value === "string" && Object.hasOwn(NON_FINITE, value) ? NON_FINITE[value] : value);

  Object.assign(bench, {receive, store: {have, load, plotly, decoded}});
})((window.implicitBench = window.implicitBench || {}));
