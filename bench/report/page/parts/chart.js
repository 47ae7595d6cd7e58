/* Charts that answer the mouse: panels of points and lines, drawn by Plotly, with a legend of buttons. */
(function (bench) {
  "use strict";

  const {element, fill} = bench.dom;
  const DASHES = {"-": "solid", "--": "dash", "-.": "dashdot", ":": "dot"};
  const SYMBOLS = {
    o: "circle",
    s: "square",
    "^": "triangle-up",
    D: "diamond",
    v: "triangle-down",
    "<": "triangle-left",
    ">": "triangle-right",
    p: "pentagon",
    h: "hexagon",
    H: "hexagon2",
    "*": "star",
    d: "diamond-tall",
    8: "octagon",
    P: "cross",
    X: "x",
  };

  /* The markers as letters, for the legend. */
  const GLYPHS = {o: "●", s: "■", "^": "▲", D: "◆", v: "▼", "<": "◄", ">": "►", p: "⬟", h: "⬢", H: "⬣", "*": "★", d: "♦"};
  Object.assign(GLYPHS, {8: "⬣", P: "✚", X: "✖"});
  const MANY = 2; // panels, beyond which the legend stands above them and stays in sight

  /* Plotly reads some markup in its texts; a name from a record has none. */
  const plain = (text) => String(text).replace(/&/g, "&amp;").replace(/</g, "&lt;").replace(/>/g, "&gt;");

  /* A chart of {panels: [{title, x: {title, log, reversed}, y: likewise, series}]}. A series is {name, colour, symbol, dash, x, y,
     text, link, low, high, size, hollow, off}: with a dash it has lines, with a symbol points. Series of one name are
     shown and hidden together. A point with a link opens it. */
  function chart(spec, {label, focus} = {}) {
    const home = element("div.chart", {role: "group", "aria-label": label || "Chart"});
    fill(home, element("p.soft", null, "Loading the chart …"));
    bench.store.plotly().then(
      (plotly) => draw(plotly, home, spec, focus),
      (error) => fill(home, element("p.soft", null, error.message)),
    );
    return home;
  }

  function draw(plotly, home, spec, focus) {
    const names = [
      ...new Set(spec.panels.flatMap((panel) => panel.series.filter(({quiet}) => !quiet).map(({name}) => name))),
    ];
    const off = new Set(
      spec.panels.flatMap((panel) => panel.series.filter((series) => series.off).map(({name}) => name)),
    );
    const places = spec.panels.map((panel) =>
      element("div.panel", {role: "img", "aria-label": panel.title || "Panel"}),
    );
    const redraw = () => places.forEach((place, number) => drawPanel(plotly, place, spec.panels[number], {off, focus}));
    const looks = new Map(spec.panels.flatMap((panel) => panel.series).map((series) => [series.name, series]));
    const entries = names.map((name) => entry(name, looks.get(name), off, redraw));
    const many = spec.panels.length > MANY;
    const legend = names.length > 1 ? element(`div.legend${many ? ".above" : ""}`, null, entries) : null;
    fill(
      home,
      many ? legend : null,
      element(`div.panels${many ? ".many" : ""}`, null, places),
      many ? null : legend,
      spec.note ? element("p.soft", null, spec.note) : null,
    );
    requestAnimationFrame(redraw);
    bench.onTheme(home, redraw);
  }

  function entry(name, look, off, redraw) {
    const glyph = GLYPHS[look.symbol];
    const swatch = element(glyph ? "span.glyph" : "span.swatch", {"aria-hidden": "true"}, glyph);
    swatch.style[glyph ? "color" : "background"] = bench.colour(look.colour);
    const toggle = (event) => {
      off.has(name) ? off.delete(name) : off.add(name);
      event.currentTarget.setAttribute("aria-pressed", String(!off.has(name)));
      redraw();
    };
    return element(
      "button.entry",
      {type: "button", "aria-pressed": String(!off.has(name)), click: toggle},
      swatch,
      name,
    );
  }

  function drawPanel(plotly, place, panel, {off, focus}) {
    if (!place.isConnected) return;
    const front = (series) => Number(series.name === focus); // drawn last, over the others
    const shown = panel.series.filter((series) => !off.has(series.name)).sort((a, b) => front(a) - front(b));
    const traces = shown.map((series) => trace(series, focus));
    plotly.react(place, traces, layout(panel, place), {displayModeBar: false, responsive: true});
    place.removeAllListeners("plotly_click");
    place.on("plotly_click", ({points: [point]}) => {
      const link = shown[point.curveNumber].link;
      const address = link && bench.dom.safeAddress(link[point.pointNumber]);
      if (address) location.hash = address;
    });
  }

  function trace(series, focus) {
    const colour = bench.colour(series.colour);
    const dim = focus && series.name !== focus ? 0.35 : 1;
    const lines = series.dash !== undefined;
    const symbol = (SYMBOLS[series.symbol] || "circle") + (series.hollow ? "-open" : "");
    const made = {
      type: "scatter",
      name: plain(series.name),
      x: series.x.map(bench.store.decoded),
      y: series.y.map(bench.store.decoded),
      mode: lines ? (series.symbol ? "lines+markers" : "lines") : "markers",
      opacity: dim,
      line: {
        color: colour,
        width: focus === series.name ? 3 : 1.6,
        dash: DASHES[series.dash] || "solid",
        shape: series.step ? "hv" : "linear",
      },
      marker: {color: colour, symbol, size: series.size || 7, line: {color: colour, width: 1.5}},
      hoverinfo: series.quiet ? "skip" : "text",
      text: hover(series),
    };
    if (series.low)
      made.error_y = {
        type: "data",
        symmetric: false,
        array: series.high.map((high, n) => high - series.y[n]),
        arrayminus: series.low.map((low, n) => series.y[n] - low),
        color: colour,
        thickness: 1,
        width: 2,
      };
    return made;
  }

  function hover(series) {
    const {number} = bench.format;
    return series.x.map((x, n) => {
      const said = series.text ? [].concat(series.text[n]) : [`${number(x)}, ${number(series.y[n])}`];
      return [`<b>${plain(series.name)}</b>`, ...said.map(plain)].join("<br>");
    });
  }

  function layout(panel, place) {
    const style = getComputedStyle(document.documentElement);
    const [text, line, card] = ["--soft", "--line", "--card"].map((name) => style.getPropertyValue(name).trim());
    const narrow = place.clientWidth < 460;
    const axis = ({title, log, reversed}, letter) => ({
      autorange: reversed ? "reversed" : true,
      ...(log
        ? ticks(
            panel.series.flatMap((series) => series[letter]),
            narrow,
          )
        : {}),
      title: {text: plain(title), standoff: 8},
      type: log ? "log" : "linear",
      gridcolor: line,
      zerolinecolor: line,
      linecolor: line,
      automargin: true,
      nticks: narrow ? 5 : 8,
    });
    return {
      title: {text: plain(panel.title || ""), font: {size: 14}, x: 0.02, xanchor: "left"},
      height: panel.height || 360,
      showlegend: false,
      margin: {l: 56, r: 12, t: panel.title ? 38 : 12, b: 46},
      hovermode: "closest",
      xaxis: axis(panel.x, "x"),
      yaxis: axis(panel.y, "y"),
      paper_bgcolor: "rgba(0,0,0,0)",
      plot_bgcolor: "rgba(0,0,0,0)",
      font: {color: text, size: 12, family: style.getPropertyValue("--font")},
      hoverlabel: {
        bgcolor: card,
        bordercolor: line,
        align: "left",
        font: {color: style.getPropertyValue("--text").trim()},
      },
    };
  }

  /* Plain numbers as ticks of a logarithmic axis: powers of ten, and 2 and 5 between them where there are few. */
  function ticks(values, narrow) {
    const known = values.map(bench.store.decoded).filter((value) => value > 0 && Number.isFinite(value));
    if (!known.length) return {};
    const [low, high] = [Math.log10(Math.min(...known)), Math.log10(Math.max(...known))];
    const span = high - low;
    const steps = span > (narrow ? 1.6 : 2.6) ? [1] : span > 0.8 ? [1, 2, 5] : [1, 1.5, 2, 3, 4, 5, 6, 8];
    const stride = span > 7 ? 2 : 1;
    const tickvals = [];
    for (let power = Math.floor(low) - 1; power <= Math.ceil(high) + 1; power += stride)
      for (const step of steps) tickvals.push(step * 10 ** power);
    const plain = (x) =>
      x >= 1e4 || x < 1e-3 ? x.toExponential(0).replace("e+", "e") : String(Number(x.toPrecision(2)));
    return {
      tickvals,
      ticktext: tickvals.map((x) =>
        x >= 1e4 && x < 1e15 ? bench.format.count(x).replace(/\.0+(?=[kMGTP])/, "") : plain(x),
      ),
    };
  }

  bench.chart = chart;
})((window.implicitBench = window.implicitBench || {}));
