/* Starts the page, and shows what the address asks for. */
(function (bench) {
  "use strict";

  const {element, fill} = bench.dom;

  function start() {
    bench.oneFile = bench.store.have("list", "about").oneFile;
    bench.runs = bench.openRuns();
    document.querySelector(".skip").addEventListener("click", (event) => {
      event.preventDefault(); // the part of the address behind the # says what is shown
      document.getElementById("main").focus();
    });
    header(bench.store.have("list", "about"));
    bench.address.follow(show);
    show();
  }

  function header(about) {
    const runs = bench.runs;
    const statuses = runs.count
      ? runs
          .values("status")
          .map((status, code) => [status, runs.codes("status").filter((each) => each === code).length])
      : [];
    fill(
      document.getElementById("counts"),
      bench.format.plural(runs.count, "run"),
      statuses.map(([status, n]) =>
        element(
          "a.counted",
          {href: bench.address.to(["runs"], {task: "all", view: "runs", status})},
          n.toLocaleString("en"),
          " ",
          bench.badge(status),
        ),
      ),
    );
    document.getElementById("tools").append(bench.themeButton());
    const problems = about.problems;
    if (problems.length)
      fill(
        document.getElementById("problems"),
        element(
          "details.note.error",
          {id: "not-read", open: problems.length < 4},
          element(
            "summary",
            null,
            `Not read: ${bench.format.plural(problems.length, "run folder")}. Nothing below includes ${problems.length > 1 ? "them" : "it"}.`,
          ),
          element(
            "ul",
            null,
            problems.map((problem) => element("li", null, problem)),
          ),
        ),
      );
    if (bench.oneFile) document.getElementById("problems").append(element("p.note", null, about.left));
  }

  let shown = false;

  const VIEWS = {
    "": (home, {query}) => bench.overview(home, {board: query}),
    runs: (home, {query}) => bench.overview(home, {board: query, alone: true}),
    run: (home, {path}) => bench.run(home, path[1] || ""),
    compare: (home, {path}) => bench.compare(home, path.slice(1)),
    table: (home, {path}) => bench.paper(home, path[1] || ""),
  };

  function show() {
    const address = bench.address.read();
    const home = document.getElementById("main");
    const view = VIEWS[address.path[0] || ""] || VIEWS[""];
    view(home, address);
    const heading = home.querySelector("h1");
    document.title = heading ? `${heading.textContent} – implicit-bench` : "implicit-bench";
    window.scrollTo(0, 0);
    if (shown) home.focus({preventScroll: true}); // of another view, so that the keyboard goes on from its start
    shown = true;
  }

  start();
})((window.implicitBench = window.implicitBench || {}));
