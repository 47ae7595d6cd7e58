/* The curve of a run, or of two: loss and error over iterations or seconds. */
(function (bench) {
  "use strict";

  const {element, fill} = bench.dom;
  const COLOURS = ["#0072b2", "#d55e00"];
  const TERMS = ["#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#8b2252", "#66a61e", "#8a8a8a"];

  /* Charts of named curves: [{name, curve}], of which some may have none. */
  function curves(named) {
    const known = named.filter(
      ({curve}) => curve && (curve.terms.length || curve.chamfer_l2.some((value) => value !== null)),
    );
    if (!known.length) return element("p.soft", null, "No curve was kept.");
    const home = element("div");
    const timed = known.every(({curve}) => curve.seconds.some((value) => value !== null));
    const buttons = [
      ["iteration", "Iterations"],
      ["seconds", "Seconds"],
    ].map(([along, name]) =>
      element(
        "button",
        {type: "button", "aria-pressed": String(along === "iteration"), click: () => show(along)},
        name,
      ),
    );
    const body = element("div");
    const show = (along) => {
      buttons.forEach((button, n) =>
        button.setAttribute("aria-pressed", String((n === 0) === (along === "iteration"))),
      );
      fill(body, bench.chart(spec(known, along), {label: "Loss and error"}));
    };
    fill(
      home,
      timed ? element("div.switch", {role: "group", "aria-label": "What the curve is drawn over"}, buttons) : null,
      body,
    );
    show("iteration");
    return home;
  }

  function spec(known, along) {
    const x = {title: along === "seconds" ? "time in the loop (seconds)" : "iteration", log: false};
    const single = known.length === 1;
    const loss = known
      .flatMap(({name, curve}, number) => {
        const terms = single ? curve.terms : curve.terms.filter((term) => term === "total");
        return terms.map((term, place) =>
          line(curve, along, term, {
            name: single ? term : name,
            colour: single ? (term === "total" ? COLOURS[0] : TERMS[place % TERMS.length]) : COLOURS[number],
            dash: term === "total" ? "-" : "--",
          }),
        );
      })
      .filter(Boolean);
    const error = known
      .map(({name, curve}, number) =>
        line(curve, along, "chamfer_l2", {
          name: single ? "error" : name,
          colour: COLOURS[number],
          dash: "-",
          symbol: "os"[number],
          factor: 1000,
        }),
      )
      .filter(Boolean);
    const panels = [];
    if (loss.length)
      panels.push({title: "Loss", x, y: {title: "loss", log: positive(loss)}, series: loss, height: 320});
    if (error.length)
      panels.push({
        title: "Error at checkpoints",
        x,
        y: {title: "Chamfer × 1000", log: positive(error)},
        series: error,
        height: 320,
      });
    return {panels};
  }

  function line(curve, along, key, {factor = 1, ...look}) {
    const {number, seconds} = bench.format;
    const values = curve[key].map(bench.store.decoded);
    const places = values
      .map((value, place) => place)
      .filter((place) => values[place] !== null && curve[along][place] !== null);
    if (!places.length || !places.some((place) => values[place] !== 0)) return null;
    return {
      ...look,
      x: places.map((place) => curve[along][place]),
      y: places.map((place) => factor * values[place]),
      text: places.map(
        (place) =>
          `iteration ${curve.iteration[place]}, ${seconds(curve.seconds[place])}: ${number(factor * values[place])}`,
      ),
    };
  }

  const positive = (series) => series.every(({y}) => y.every((value) => value > 0 || Number.isNaN(value)));

  bench.curves = curves;
})((window.implicitBench = window.implicitBench || {}));
