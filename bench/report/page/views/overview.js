/* The first screen: each question with its verdict in a sentence, other tables and figures, then the leaderboards. */
(function (bench) {
  "use strict";

  const {element, fill, emphasised} = bench.dom;

  /* Alone, the leaderboards are all that is shown. */
  function overview(home, {board, alone}) {
    const papers = alone ? [] : bench.store.have("list", "papers") || [];
    const answered = papers.filter((paper) => paper.verdict);
    const others = papers.filter((paper) => !paper.verdict);
    const boards = element("section", {"aria-labelledby": "board"});
    fill(
      home,
      element("h1.unseen", null, alone ? "Leaderboards" : "All results"),
      answered.length
        ? element(
            "section",
            {"aria-labelledby": "answers"},
            element("h2", {id: "answers"}, "What the tables answer"),
            element("div.verdicts", null, answered.map(card)),
          )
        : null,
      others.length
        ? element(
            "section",
            {"aria-labelledby": "others"},
            element("h2", {id: "others"}, answered.length ? "More tables and figures" : "Tables and figures"),
            element("ul.links", null, others.map(listed)),
          )
        : null,
      boards,
    );
    if (bench.runs.count) bench.board(boards, board);
    else fill(boards, element("h2", {id: "board"}, "Runs"), nothing());
  }

  function card(paper) {
    return element(
      "a.verdict",
      {href: bench.address.to(["table", paper.name])},
      element("span.question", null, paper.question),
      element("span.answer", null, emphasised(paper.verdict)),
      element("span.from", null, paper.title),
    );
  }

  function listed(paper) {
    return element("li", null, element("a", {href: bench.address.to(["table", paper.name])}, paper.title));
  }

  function nothing() {
    return element(
      "p",
      null,
      "No run was read. Make one: ",
      element("code", null, "python -m bench task=completion renderer=dist"),
    );
  }

  bench.overview = overview;
})((window.implicitBench = window.implicitBench || {}));
