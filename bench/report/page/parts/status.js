/* A status as a mark, a word and a colour: never by its colour alone. */
(function (bench) {
  "use strict";

  const {element} = bench.dom;
  const KINDS = {
    ok: ["good", "✓"],
    not_reached: ["warn", "↘"],
    timeout: ["warn", "◷"],
    oom: ["warn", "▦"],
    unsupported: ["mute", "–"],
    not_run: ["mute", "○"],
    killed: ["bad", "■"],
    nan: ["bad", "?"],
    diverged: ["bad", "↗"],
    empty: ["bad", "∅"],
    crashed: ["bad", "✕"],
    refused: ["bad", "✕"],
  };

  function badge(status) {
    const [tone, mark] = KINDS[status];
    return element(
      `span.status.${tone}`,
      null,
      element("span.mark", {"aria-hidden": "true"}, mark),
      status.replace("_", " "),
    );
  }

  bench.badge = badge;
})((window.implicitBench = window.implicitBench || {}));
