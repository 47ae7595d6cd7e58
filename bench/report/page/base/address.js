/* The address of the view, after the #: a path, and a query that restores filters, sorting and search. */
(function (bench) {
  "use strict";

  /* {path: ["run", "folder"], query: {sort: "loop"}} */
  function read() {
    const [path, query] = location.hash.replace(/^#\/?/, "").split("?");
    const entries = new URLSearchParams(query || "");
    return {path: path.split("/").filter(Boolean).map(decode), query: Object.fromEntries(entries)};
  }

  function decode(part) {
    try {
      return decodeURIComponent(part);
    } catch {
      return part;
    }
  }

  /* The link to a view; empty values of the query are left out. */
  function to(path, query = {}) {
    const kept = Object.entries(query).filter(([, value]) => value !== "" && value !== null && value !== undefined);
    const words = new URLSearchParams(kept).toString();
    return `#/${path.map(encodeURIComponent).join("/")}${words ? `?${words}` : ""}`;
  }

  let quiet = null;

  /* Writes the address without a new entry in the history, and without showing it again. */
  function keep(path, query) {
    const link = to(path, query);
    if (link === location.hash) return;
    quiet = link;
    location.replace(link);
  }

  /* Calls `show` when the address changes, except by `keep`. */
  function follow(show) {
    window.addEventListener("hashchange", () => {
      const own = quiet !== null && location.hash === quiet;
      quiet = null;
      if (!own) show();
    });
  }

  bench.address = {read, to, keep, follow};
})((window.implicitBench = window.implicitBench || {}));
