/* The curve of a run, or of two: loss and error over iterations or seconds. */
(function (bench) {
  "use strict";

  const {element, fill, choice} = bench.dom;
  const {number, seconds} = bench.format;
  const COLOURS = ["#0072b2", "#d55e00"];
  const TERMS = ["#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#8b2252", "#66a61e", "#8a8a8a"];

  /* Charts of named curves: [{name, curve}], of which some may have none. */
  function curves(named) {
    const known = named.filter(({curve}) => curve && (curve.terms.length || curve.chamfer_l2.some((value) => value !== null)));
    if (!known.length) return element("p.soft", null, "No curve was kept.");
    const body = element("div");
    const show = (along) => fill(body, bench.chart({panels: panels(known, along)}, {label: "Loss and error"}));
    const timed = known.every(({curve}) => curve.seconds.some((value) => value !== null));
    show("iteration");
    return [timed && choice("What the curve is drawn over", {iteration: "Iterations", seconds: "Seconds"}, "iteration", show), body];
  }

  /* The loss, by its terms where there is one curve, and the error at checkpoints. */
  function panels(known, along) {
    const x = {title: along === "seconds" ? "seconds of optimisation" : "iteration", log: false};
    const single = known.length === 1;
    const loss = known.flatMap(({name, curve}, n) =>
      curve.terms.filter((term) => single || term === "total").map((term, place) => {
        const own = single && term !== "total" ? TERMS[place % TERMS.length] : COLOURS[n];
        return line(curve, along, term, {name: single ? term : name, colour: own, dash: term === "total" ? "-" : "--"});
      }));
    const error = known.map(({name, curve}, n) =>
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
    const places = values.map((_, place) => place).filter((place) => values[place] !== null && curve[along][place] !== null);
    if (places.every((place) => values[place] === 0)) return null;
    const said = (place) => `iteration ${curve.iteration[place]}, ${seconds(curve.seconds[place])}: ${number(values[place], factor)}`;
    return {
      ...look,
      x: places.map((place) => curve[along][place]),
      y: places.map((place) => factor * values[place]),
      text: places.map(said),
    };
  }

  bench.curves = curves;
})((window.implicitBench = window.implicitBench || {}));
