/* One table for all: headings sort it, a long one has pages, arrow keys go from row to row, and boxes pick two runs. */
(function (bench) {
  "use strict";

  const {element, fill, soft} = bench.dom;
  const ON_A_PAGE = 100;
  const LONGEST_LINE = 44; // characters of a cell that stays in one line

  /* A table of columns {key, label, unit, kind, head, cell, get, down} over items, in an element of its own.
     A column with `get` sorts; with `down` from the greatest. `state` is {sort, order, page}, `changed` gets it;
     without it items are sorted by the column `first`, or as they come. `ordered` gets the items in their order. */
  function table(columns, items, {caption, state = {}, changed, first, ordered, cards} = {}) {
    const home = element(`div${cards ? ".cards" : ""}`);
    const find = (key) => columns.find((column) => column.get && column.key === key);

    function set(changes, focused) {
      Object.assign(state, {page: ""}, changes);
      if (changed) changed(state);
      show();
      if (focused) home.querySelector(`[data-key="${CSS.escape(focused)}"]`).focus();
      else home.scrollIntoView();
    }

    function show() {
      const by = find(state.sort) || find(first);
      const down = by && (by.key === state.sort && state.order ? state.order === "down" : Boolean(by.down));
      const all = by ? sort(items, by.get, down) : items;
      if (ordered) ordered(all);
      const pages = Math.max(1, Math.ceil(all.length / ON_A_PAGE));
      const page = Math.min(Math.max(1, Number(state.page) || 1), pages);
      const press = (key) => set({sort: key, order: by && by.key === key ? (down ? "up" : "down") : ""}, key);
      const rows = all.slice((page - 1) * ON_A_PAGE, page * ON_A_PAGE);
      const made = element("table.list", {keydown: follow},
        element("thead", null, element("tr", null, columns.map((column) => heading(column, column === by, down, press)))),
        element("tbody", null, rows.map((item) => element("tr", null, columns.map((column) => cell(column, item))))));
      fill(home,
        cards && chooser(columns.filter(({get}) => get), by, set),
        element("div.wide", {tabindex: 0, role: "region", "aria-label": caption || "Table"}, made),
        pages > 1 && pager(page, pages, set));
    }

    show();
    return home;
  }

  function heading({key, label, unit, kind, get}, own, down, press) {
    const arrow = element("span.arrow", {"aria-hidden": "true"}, own ? (down ? "▼" : "▲") : "");
    const button = () => element("button.sort", {type: "button", "data-key": key, click: () => press(key)}, label, arrow);
    const order = own ? (down ? "descending" : "ascending") : null;
    const small = unit && element("small", null, unit);
    return element(`th.${kind || "words"}`, {scope: "col", "aria-sort": order}, get ? button() : label, small);
  }

  const cell = ({label, kind, head, cell: show}, item) =>
    element(`${head ? "th" : "td"}.${kind || "words"}`, {"data-label": label, scope: head && "row"}, show(item));

  /* A phone shows this instead of the headings. */
  function chooser(columns, by, set) {
    const options = columns.map(({key, label}) => element("option", {value: key}, label));
    const change = ({target}) => set({sort: target.value, order: ""}, "sort");
    const select = element("select", {"data-key": "sort", "aria-label": "Sort by", change}, options);
    select.value = by.key;
    return element("label.pick.narrow", null, "Sort by", select);
  }

  function pager(page, pages, set) {
    const button = (to, name) =>
      element("button", {type: "button", disabled: to < 1 || to > pages, click: () => set({page: to === 1 ? "" : String(to)})}, name);
    return element("nav.pager", {"aria-label": "Pages of the list"},
      ...[button(1, "« First"), button(page - 1, "‹ Previous")],
      element("span", null, `Page ${page} of ${pages.toLocaleString("en")}`),
      ...[button(page + 1, "Next ›"), button(pages, "Last »")]);
  }

  /* Up and down go to the link of the row above or below. */
  function follow(event) {
    const row = event.target.closest("tbody tr");
    const next = row && {ArrowDown: row.nextElementSibling, ArrowUp: row.previousElementSibling}[event.key];
    const link = next && !event.target.matches("input") && next.querySelector("a:not([tabindex])");
    if (!link) return;
    event.preventDefault();
    link.focus();
  }

  /* Sorts items by a value; items without a value come last in either direction. */
  function sort(items, get, down) {
    const missing = (value) => value === null || value === undefined || value === "" || Number.isNaN(value);
    const values = items.map((item, index) => ({item, index, value: get(item)}));
    values.sort((a, b) => {
      if (missing(a.value) || missing(b.value)) return missing(a.value) - missing(b.value) || a.indexOf - b.indexOf;
      return a.value === b.value ? a.indexOf - b.indexOf : a.value < b.value === !down ? -1 : 1;
    });
    return values.map(({item}) => item);
  }

  /* The table of a page that was written as text: numbers to the right, and sorted by the first number of a cell.
     `best` are rows and columns of cells that are set bold. The column `named` has a row's name, and its `link`. */
  function written(header, rows, {best = [], named, link} = {}) {
    const bold = new Set(best.map(String));
    const heads = Math.max(0, header.indexOf(named));
    const columns = header.map((label, index) => {
      const cells = rows.map((row) => row[index] || "");
      const filled = cells.filter((text) => text && text !== "–" && text !== "∞");
      const numeric = filled.length > 0 && filled.filter((text) => NUMBER.test(text)).length >= 0.7 * filled.length;
      const line = Math.max(0, ...cells.map((text) => text.length)) <= LONGEST_LINE;
      const kind = numeric ? "number" : line ? "words.line" : "words";
      const get = (row) => (numeric ? leading(row[index]) : (row[index] || "").toLowerCase());
      const text = (row) => (bold.has(`${rows.indexOf(row)},${index}`) ? element("strong", null, row[index]) : row[index]);
      const cell = link && index === heads ? (row) => element("a", {href: link(row[index])}, row[index]) : text;
      return {key: String(index), label, kind, get, head: index === heads, cell};
    });
    return table(columns, rows);
  }

  const NUMBER = /^[^\w–]*(-?[\d.,]+(?:e-?\d+)?)\s*([kMGTP](?=B?\b))?/;
  const UNITS = {ms: 1e-3, min: 60, h: 3600, k: 1e3, M: 1e6, G: 1e9, T: 1e12, P: 1e15};

  /* The first number of a text, such as 1.43M or 12 ms; infinite for ∞, null without a number. */
  function leading(text) {
    const found = NUMBER.exec(text || "");
    if (text === "∞" || !found) return text === "∞" ? Infinity : null;
    const unit = /\d\s*(ms|min|h)\b/.exec(text);
    return Number(found[1].replace(/,/g, "")) * (UNITS[unit ? unit[1] : found[2]] || 1);
  }

  let picked = [];

  /* A box that picks a run to compare; a third one replaces the second. */
  function pick(index) {
    const change = ({target}) => choose([...picked.filter((each) => each !== index).slice(0, 1), ...(target.checked ? [index] : [])]);
    const checked = picked.includes(index);
    return element("input", {type: "checkbox", "aria-label": `Compare ${bench.runs.title(index)}`, "data-pick": index, checked, change});
  }

  /* Shows the picked runs in a bar at the lower edge. */
  function choose(indices) {
    picked = indices;
    for (const box of document.querySelectorAll("[data-pick]")) box.checked = picked.includes(Number(box.dataset.pick));
    const home = document.getElementById("picks");
    home.hidden = !picked.length;
    const href = bench.address.to(["compare", ...picked.map(bench.runs.name)]);
    fill(home,
      picked.map((index, n) => element("span.picked", null, element(`b.${"ab"[n]}`, null, "AB"[n]), bench.runs.title(index))),
      picked.length === 2 ? element("a.button", {href}, "Compare") : soft("Pick another run to compare with."),
      element("button", {type: "button", click: () => choose([])}, "Clear"));
  }

  Object.assign(bench, {table, written, pick});
})((window.implicitBench = window.implicitBench || {}));
