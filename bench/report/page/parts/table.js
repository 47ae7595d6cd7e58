/* A table whose headings sort it, whose rows follow the arrow keys, and whose cells have their headings on a phone. */
(function (bench) {
  "use strict";

  const {element, fill} = bench.dom;
  const LONGEST_LINE = 44; // characters of a cell that stays in one line

  /* A table of columns {key, label, unit, cell, kind, sortable} over items.
     `order` is {key, down}; `sorted` is called with the key of a heading that is pressed. */
  function table(columns, items, {order, sorted, caption, rowLabel} = {}) {
    const head = element(
      "tr",
      null,
      columns.map((column) => heading(column, order, sorted)),
    );
    const rows = items.map((item) =>
      element(
        "tr",
        {},
        columns.map((column) => cell(column, item)),
      ),
    );
    return element(
      "table.list",
      {keydown: follow},
      element("caption.unseen", null, caption || ""),
      element("thead", null, head),
      element("tbody", null, rows),
    );
  }

  function heading(column, order, sorted) {
    const own = order && order.key === column.key;
    const direction = own ? (order.down ? "descending" : "ascending") : null;
    const shown =
      column.sortable && sorted
        ? element(
            "button.sort",
            {type: "button", click: () => sorted(column.key), "data-key": column.key},
            column.label,
            element("span.arrow", {"aria-hidden": "true"}, own ? (order.down ? "▼" : "▲") : ""),
            column.unit ? element("small", null, column.unit) : null,
          )
        : [column.label, column.unit ? element("small", null, column.unit) : null];
    return element(`th.${column.kind || "words"}`, {scope: "col", "aria-sort": direction}, shown);
  }

  function cell(column, item) {
    const content = column.cell(item);
    const kind = column.head ? "th" : "td";
    return element(
      `${kind}.${column.kind || "words"}`,
      {"data-label": column.label, scope: column.head ? "row" : null},
      content,
    );
  }

  /* Up and down go to the link of the row above or below. */
  function follow(event) {
    const step = {ArrowDown: 1, ArrowUp: -1}[event.key];
    const row = event.target.closest("tbody tr");
    if (!step || !row || event.target.matches("input, select")) return;
    const rows = [...row.parentElement.children];
    const next = rows[rows.indexOf(row) + step];
    const link = next && next.querySelector("a:not([tabindex])");
    if (!link) return;
    event.preventDefault();
    link.focus();
  }

  /* The table of a page that was written as text: numbers to the right, and sorted by the first number of a cell. */
  function written(header, rows, {link} = {}) {
    const longest = header.map((_, place) => Math.max(0, ...rows.map((row) => (row[place] || "").length)));
    const numeric = header.map((_, place) => isNumeric(rows.map((row) => row[place] || "")));
    const home = element("div.wide", {tabindex: 0, role: "region", "aria-label": "Table"});
    let order = null;
    const columns = header.map((label, place) => ({
      key: String(place),
      label,
      sortable: true,
      head: place === 0,
      kind: numeric[place] ? "number" : longest[place] <= LONGEST_LINE ? "words.line" : "words",
      cell: (row) => (link && link(row, place)) || row[place],
    }));
    const show = () => {
      const place = order && Number(order.key);
      const get = (row) => (numeric[place] ? leading(rows[row][place]) : (rows[row][place] || "").toLowerCase());
      const places = rows.map((_, row) => row);
      const shown = order ? bench.filter.sort(places, get, order.down) : places;
      fill(
        home,
        table(
          columns,
          shown.map((row) => rows[row]),
          {order, sorted: press},
        ),
      );
    };
    const press = (key) => {
      order = order && order.key === key ? (order.down ? null : {key, down: true}) : {key, down: false};
      show();
      home.querySelector(`[data-key="${key}"]`).focus();
    };
    show();
    return home;
  }

  const NUMBER = /^[^\w–]*(-?[\d.,]+(?:e-?\d+)?)\s*([kMGTP]?)/;

  function isNumeric(cells) {
    const filled = cells.filter((text) => text && text !== "–" && text !== "∞");
    return filled.length > 0 && filled.filter((text) => NUMBER.test(text)).length >= 0.7 * filled.length;
  }

  const UNITS = {ms: 1e-3, min: 60, h: 3600};

  /* The first number of a text, such as 1.43M or 12 ms; infinite for ∞, null where there is none. */
  function leading(text) {
    if (text === "∞") return Infinity;
    const found = NUMBER.exec(text || "");
    if (!found) return null;
    const unit = /(?:\d)\s*(ms|min|h)\b/.exec(text);
    const value = Number(found[1].replace(/,/g, ""));
    return value * (unit ? UNITS[unit[1]] : 1000 ** Math.max(0, " kMGTP".indexOf(found[2] || " ")));
  }

  bench.table = {table, written, leading};
})((window.implicitBench = window.implicitBench || {}));
