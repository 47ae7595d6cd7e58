/* Charts that answer the mouse: panels of points and lines, drawn by Plotly, with a legend of buttons. */
(function (bench) {
  "use strict";

  const {element, later} = bench.dom;
  const {decoded} = bench.store;
  const {number, count} = bench.format;
  const DASHES = new Map([["-", "solid"], ["--", "dash"], ["-.", "dashdot"], [":", "dot"]]);
  const SYMBOLS = new Map([ // Plotly's name of a marker, and a letter for the legend
    ...[["o", "circle", "●"], ["s", "square", "■"], ["^", "triangle-up", "▲"], ["v", "triangle-down", "▼"]],
    ...[["<", "triangle-left", "◄"], [">", "triangle-right", "►"], ["D", "diamond", "◆"], ["d", "diamond-tall", "♦"]],
    ...[["p", "pentagon", "⬟"], ["h", "hexagon", "⬢"], ["H", "hexagon2", "⬣"], ["8", "octagon", "⬣"]],
    ...[["*", "star", "★"], ["P", "cross", "✚"], ["X", "x", "✖"]],
  ].map(([key, ...look]) => [key, look]));
  const MANY = 2; // panels, beyond which the legend stands above them and stays in sight

  /* Plotly reads some markup in its texts; a name from a record has none. */
  const plain = (text) => String(text).replace(/&/g, "&amp;").replace(/</g, "&lt;").replace(/>/g, "&gt;");

  /* A chart of {panels: [{title, x: {title, log, reversed}, y: likewise, rows, series}]}. A series is {name, colour, symbol,
     dash, x, y, text, link, low, high, size, hollow, off, shapes}: with a dash it has lines, with a symbol points. Series of one name
     are shown and hidden together. A point with a link opens it. `focus` is the name of the series to bring out. With
     `rows`, their names stand down the y axis instead of a legend, and `low` and `high` are of x. */
  function chart(spec, {label, focus} = {}) {
    const shown = later(bench.store.plotly(), (plotly) => drawn(plotly, spec, focus));
    return element("div.chart", {role: "group", "aria-label": label || "Chart"}, shown);
  }

  function drawn(plotly, spec, focus) {
    const series = spec.panels.flatMap((panel) => panel.series);
    const off = new Set(series.filter((each) => each.off).map(({name}) => name));
    const looks = new Map(series.map((each) => [each.name, each]));
    const names = [...new Set(series.filter(({quiet}) => !quiet).map(({name}) => name))];
    const targets = spec.panels.map(({title}) => element("div.panel", {role: "img", "aria-label": title || "Panel"}));
    const redraw = () => targets.forEach((target, n) => drawPanel(plotly, target, spec.panels[n], off, focus));
    const many = spec.panels.length > MANY;
    const entries = names.map((name) => entry(looks.get(name), off, redraw));
    const legend = names.length > 1 && !spec.panels.some(({rows}) => rows) && element(`div.legend${many ? ".above" : ""}`, null, entries);
    const panels = element(`div.panels${many ? ".many" : ""}`, null, targets);
    requestAnimationFrame(redraw);
    bench.onTheme(panels, redraw);
    return [many && legend, panels, !many && legend, spec.note && element("p.soft", null, spec.note)];
  }

  /* A button of the legend, which shows and hides a series: its marker, or its line if it has steps or no markers. */
  function entry({name, symbol, colour, dash, step}, off, redraw) {
    const [, glyph] = (!step && SYMBOLS.get(symbol)) || [];
    const line = step || (dash !== undefined && !glyph);
    const swatch = element(glyph ? "span.glyph" : line ? "span.stroke" : "span.swatch", {"aria-hidden": "true"}, glyph);
    swatch.style[glyph ? "color" : line ? "borderColor" : "background"] = bench.colour(colour);
    if (line) swatch.style.borderTopStyle = {solid: "solid", dot: "dotted"}[DASHES.get(dash)] || "dashed";
    const click = ({currentTarget}) => {
      off.has(name) ? off.delete(name) : off.add(name);
      currentTarget.setAttribute("aria-pressed", String(!off.has(name)));
      redraw();
    };
    return element("button.entry", {type: "button", "aria-pressed": String(!off.has(name)), click}, swatch, name);
  }

  function drawPanel(plotly, target, panel, off, focus) {
    if (!target.isConnected) return;
    const front = ({name}) => Number(name === focus); // drawn last, over the others
    const shown = panel.series.filter(({name}) => !off.has(name)).sort((a, b) => front(a) - front(b));
    const edge = panel.rows ? null : upperEdge(shown, panel.y);
    const traces = shown.map((series) => trace(series, focus, panel.rows ? "x" : "y", edge));
    traces.push(...shown.filter(({shapes}) => shapes).map(dots)); // last, so that a number is that of a series
    plotly.react(target, traces, layout(panel, target), {displayModeBar: false, responsive: true});
    target.removeAllListeners("plotly_click");
    target.on("plotly_click", ({points: [point]}) => {
      const {link} = shown[point.curveNumber] || {};
      const address = link && bench.dom.safeAddress(link[point.pointNumber]);
      if (address) location.hash = address;
    });
  }

  /* Where infinite values stand, those of rows that failed: a little above all others. */
  function upperEdge(shown, {log}) {
    const values = shown.flatMap(({y, shapes = []}) => [...y, ...shapes.map((pair) => pair[1])].map(decoded)).filter(Number.isFinite);
    const [low, high] = [Math.min(...values), Math.max(...values)];
    return !values.length ? 1 : log ? high * 1.3 : high + 0.15 * (high - low || 1);
  }

  function trace(series, focus, letter, edge) {
    const color = bench.colour(series.colour);
    const lines = series.dash !== undefined;
    const dash = DASHES.get(series.dash) || "solid";
    const [symbol] = SYMBOLS.get(series.symbol) || ["circle"];
    const width = focus === series.name ? 3 : 1.6;
    const y = series.y.map(decoded);
    const failed = edge === null ? [] : y.map((value) => value === Infinity);
    const made = {
      type: "scatter",
      name: plain(series.name),
      x: series.x.map(decoded),
      y: y.map((value, n) => (failed[n] ? edge : value)),
      mode: lines ? (series.symbol && !series.step ? "lines+markers" : "lines") : "markers",
      opacity: focus && series.name !== focus ? 0.35 : 1,
      line: {color, width, dash, shape: series.step ? "hv" : "linear"},
      marker: {color, symbol: y.map((_, n) => (failed[n] ? "x" : symbol + (series.hollow ? "-open" : ""))), size: series.size || 7, line: {color, width: 1.5}},
      hoverinfo: series.quiet ? "skip" : "text",
      text: hover(series),
    };
    if (series.low) {
      const [array, arrayminus] = [series.high, series.low].map((ends) => ends.map((end, n) => Math.abs(end - series[letter][n])));
      made[`error_${letter}`] = {type: "data", symmetric: false, array, arrayminus, color, thickness: 1, width: 2};
    }
    return made;
  }

  /* The small points of a series: its runs, or its shapes. */
  function dots({shapes, colour}) {
    const [x, y] = [0, 1].map((index) => shapes.map((pair) => decoded(pair[index])));
    const marker = {color: bench.colour(colour), size: 4, opacity: 0.5};
    return {type: "scatter", mode: "markers", x, y, marker, hoverinfo: "skip"};
  }

  const hover = ({name, x, y, text}) =>
    x.map((each, n) => {
      const lines = text ? [].concat(text[n]) : [`${number(each)}, ${number(y[n])}`];
      return [`<b>${plain(name)}</b>`, ...lines.map(plain)].join("<br>");
    });

  function layout(panel, target) {
    const style = getComputedStyle(document.documentElement);
    const own = (name) => style.getPropertyValue(name).trim();
    const [line, narrow] = [own("--line"), target.clientWidth < 460];
    const axis = ({title, log, reversed}, letter) => ({
      ...(log ? ticks(panel.series.flatMap((series) => series[letter]), narrow) : {}),
      autorange: reversed ? "reversed" : true,
      title: {text: plain(title), standoff: 8},
      type: log ? "log" : "linear",
      ...{gridcolor: line, zerolinecolor: line, linecolor: line},
      automargin: true,
      nticks: narrow ? 5 : 8,
    });
    return {
      title: {text: plain(panel.title || ""), font: {size: 14}, x: 0.02, xanchor: "left"},
      height: panel.height || (panel.rows ? 110 + 24 * panel.rows.length : 360),
      showlegend: false,
      margin: {l: 56, r: 12, t: panel.title ? 38 : 12, b: 46},
      hovermode: "closest",
      xaxis: axis(panel.x, "x"),
      yaxis: {...axis(panel.y, "y"), ...(panel.rows ? namedAxis(panel.rows) : {})},
      ...{paper_bgcolor: "rgba(0,0,0,0)", plot_bgcolor: "rgba(0,0,0,0)"},
      font: {color: own("--soft"), size: 12, family: own("--font")},
      hoverlabel: {bgcolor: own("--card"), bordercolor: line, align: "left", font: {color: own("--text")}},
    };
  }

  const namedAxis = (names) => {
    const tickvals = names.map((_, index) => index);
    return {tickvals, ticktext: names.map(plain), range: [names.length - 0.5, -0.5], autorange: false};
  };

  /* Plain numbers as ticks of a logarithmic axis: powers of ten, and numbers between them where there are few. */
  function ticks(values, narrow) {
    const finite = values.map(decoded).filter((value) => value > 0 && Number.isFinite(value));
    if (!finite.length) return {};
    const [low, high] = [Math.log10(Math.min(...finite)), Math.log10(Math.max(...finite))];
    const span = high - low;
    const steps = span > (narrow ? 1.6 : 2.6) ? [1] : span > 0.8 ? [1, 2, 5] : [1, 1.5, 2, 3, 4, 5, 6, 8];
    const tickvals = [];
    for (let power = Math.floor(low) - 1; power <= Math.ceil(high) + 1; power += span > 7 ? 2 : 1)
      tickvals.push(...steps.map((step) => step * 10 ** power));
    const text = (x) => {
      if (x >= 1e4 && x < 1e15) return count(x).replace(/\.0+(?=[kMGTP])/, "");
      return x >= 1e4 || x < 1e-3 ? x.toExponential(0).replace("e+", "e") : String(Number(x.toPrecision(2)));
    };
    return {tickvals, ticktext: tickvals.map(text)};
  }

  bench.chart = chart;
})((window.implicitBench = window.implicitBench || {}));
