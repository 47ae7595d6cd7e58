/* Starts the page, and shows what the address asks for. */
(function (bench) {
  "use strict";

  const {element, fill, details, list} = bench.dom;
  const {plural} = bench.format;
  const VIEWS = new Map([
    ["", (home, {query}) => bench.overview(home, query)],
    ["tables", (home) => bench.tables(home)],
    ["renderer", (home, {path}) => bench.renderer(home, path[1] || "")],
    ["runs", (home, {query}) => bench.leaderboards(home, query)],
    ["run", (home, {path}) => bench.run(home, path[1] || "")],
    ["compare", (home, {path}) => bench.compare(home, path.slice(1))],
    ["table", (home, {path}) => bench.paper(home, path[1] || "")],
  ]);
  let shown = false;

  function start() {
    const about = bench.store.have("list", "about");
    bench.runs = bench.openRuns();
    document.querySelector(".skip").addEventListener("click", (event) => {
      event.preventDefault(); // the part of the address behind the # says what is shown
      document.getElementById("main").focus();
    });
    document.getElementById("tools").append(bench.themeButton());
    fill(document.getElementById("counts"), plural(bench.runs.count, "run"), bench.runs.count ? counts() : null);
    fill(document.getElementById("problems"), problems(about.problems));
    bench.address.follow(show);
    show();
  }

  /* How many runs have each status. */
  function counts() {
    return bench.runs.values("status").map((status, code) => {
      const n = bench.runs.codes("status").filter((each) => each === code).length;
      const href = bench.address.to(["runs"], {task: "all", view: "runs", status});
      return element("a.counted", {href}, n.toLocaleString("en"), " ", bench.badge(status));
    });
  }

  function problems(said) {
    if (!said.length) return null;
    const none = `Nothing below includes ${said.length > 1 ? "them" : "it"}.`;
    const home = details(`Not read: ${plural(said.length, "run folder")}. ${none}`, list(said));
    return Object.assign(home, {id: "not-read", className: "note error", open: said.length < 4});
  }

  function show() {
    const address = bench.address.read();
    const home = document.getElementById("main");
    (VIEWS.get(address.path[0]) || VIEWS.get(""))(home, address);
    const heading = home.querySelector("h1");
    document.title = heading ? `${heading.textContent} – implicit-bench` : "implicit-bench";
    window.scrollTo(0, 0);
    if (shown) home.focus({preventScroll: true}); // of another view, so that the keyboard goes on from its start
    shown = true;
  }

  start();
})((window.implicitBench = window.implicitBench || {}));
