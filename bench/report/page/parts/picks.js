/* The two runs that are picked for comparison, in a bar at the lower edge. */
(function (bench) {
  "use strict";

  const {element, fill} = bench.dom;
  let picked = [];

  /* A box that picks a run; a third one takes the place of the second. */
  function box(place) {
    return element("input", {
      type: "checkbox",
      "aria-label": `Compare ${bench.runs.title(place)}`,
      checked: picked.includes(place),
      "data-pick": place,
      change: (event) => pick(place, event.target.checked),
    });
  }

  function pick(place, wanted) {
    picked = picked.filter((other) => other !== place);
    if (wanted) picked = [...picked.slice(0, 1), place];
    for (const input of document.querySelectorAll("[data-pick]"))
      input.checked = picked.includes(Number(input.dataset.pick));
    show();
  }

  function show() {
    const home = document.getElementById("picks");
    home.hidden = !picked.length;
    const names = picked.map((place, number) =>
      element("span.picked", null, element(`b.${"ab"[number]}`, null, "AB"[number]), bench.runs.title(place)),
    );
    const link =
      picked.length === 2
        ? element("a.button", {href: bench.address.to(["compare", ...picked.map(bench.runs.name)])}, "Compare")
        : element("span.soft", null, "Pick another run to compare with.");
    fill(home, names, link, element("button", {type: "button", click: clear}, "Clear"));
  }

  function clear() {
    for (const place of [...picked]) pick(place, false);
  }

  bench.picks = {box, pick, clear, has: (place) => picked.includes(place)};
})((window.implicitBench = window.implicitBench || {}));
