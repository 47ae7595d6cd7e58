/* The curve of a run, or of two: loss and error over iterations or seconds. */
(function (bench) {
  "use strict";

  const {element, fill, choice} = bench.dom;
  const {number, seconds} = bench.format;
  const COLOURS = ["#0072b2", "#d55e00"];
  const TERMS = ["#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#8b2252", "#66a61e", "#8a8a8a"];

  /* Charts of named curves: [{name, curve}], of which some may have none. */
  function curves(named) {
    const filled = named.filter(({curve}) => curve && (curve.terms.length || curve.chamfer_l2.some((value) => value !== null)));
    if (!filled.length) return element("p.soft", null, "No curve was kept.");
    const body = element("div");
    const show = (along) => fill(body, bench.chart({panels: panels(filled, along)}, {label: "Loss and error"}));
    const timed = filled.every(({curve}) => curve.seconds.some((value) => value !== null));
    show("iteration");
    return [timed && choice("What the curve is drawn over", {iteration: "Iterations", seconds: "Seconds"}, "iteration", show), body];
  }

  /* The loss, by its terms where there is one curve, and the error at checkpoints. */
  function panels(filled, along) {
    const x = {title: along === "seconds" ? "seconds of optimisation" : "iteration", log: false};
    const single = filled.length === 1;
    const loss = filled.flatMap(({name, curve}, n) =>
      curve.terms.filter((term) => single || term === "total").map((term, index) => {
        const own = single && term !== "total" ? TERMS[index % TERMS.length] : COLOURS[n];
        return line(curve, along, term, {name: single ? term : name, colour: own, dash: term === "total" ? "-" : "--"});
      }));
    const error = filled.map(({name, curve}, n) =>
      line(curve, along, "chamfer_l2", {name: single ? "error" : name, colour: COLOURS[n], dash: "-", symbol: "os"[n]}, 1000));
    return [["Loss", "loss", loss], ["Error at checkpoints", "Chamfer × 1000", error]].flatMap(([title, unit, lines]) => {
      const series = lines.filter(Boolean);
      const log = series.every(({y}) => y.every((value) => value > 0 || Number.isNaN(value)));
      return series.length ? [{title, x, y: {title: unit, log}, series, height: 320}] : [];
    });
  }

  /* A line of a column of the curve; null where it has no value, or zeros alone. */
  function line(curve, along, key, look, factor = 1) {
    const values = curve[key].map(bench.store.decoded);
    const indices = values.map((_, index) => index).filter((index) => values[index] !== null && curve[along][index] !== null);
    if (indices.every((index) => values[index] === 0)) return null;
    const hoverText = (index) => `iteration ${curve.iteration[index]}, ${seconds(curve.seconds[index])}: ${number(values[index], factor)}`;
    return {
      ...look,
      x: indices.map((index) => curve[along][index]),
      y: indices.map((index) => factor * values[index]),
      text: indices.map(hoverText),
    };
  }

  bench.curves = curves;
})((window.implicitBench = window.implicitBench || {}));
