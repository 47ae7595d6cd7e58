/* Light and dark: as the system has it, or as the reader chose; and colours that stay visible on either. */
(function (bench) {
  "use strict";

  const MODES = {auto: "As the system", light: "Light", dark: "Dark"};
  const KEY = "implicit-bench-theme";
  const system = window.matchMedia("(prefers-color-scheme: dark)");
  const redraws = new Map();

  function kept() {
    try {
      return localStorage.getItem(KEY) in MODES ? localStorage.getItem(KEY) : "auto";
    } catch {
      return "auto"; // a browser that keeps nothing for files
    }
  }

  let mode = kept();
  const dark = () => (mode === "auto" ? system.matches : mode === "dark");

  function apply() {
    document.documentElement.dataset.theme = dark() ? "dark" : "light";
    for (const [home, redraw] of redraws) home.isConnected ? redraw() : redraws.delete(home);
  }

  function button() {
    const next = () => Object.keys(MODES)[(Object.keys(MODES).indexOf(mode) + 1) % 3];
    const label = () => `Colours: ${MODES[mode].toLowerCase()}. Change to ${MODES[next()].toLowerCase()}.`;
    const mark = () => ({auto: "◐", light: "☀", dark: "☾"})[mode];
    return bench.dom.element(
      "button.theme",
      {
        type: "button",
        "aria-label": label(),
        title: label(),
        click: (event) => {
          mode = next();
          try {
            localStorage.setItem(KEY, mode);
          } catch {
            // kept until the page is closed
          }
          event.currentTarget.textContent = mark();
          event.currentTarget.setAttribute("aria-label", label());
          event.currentTarget.title = label();
          apply();
        },
      },
      mark(),
    );
  }

  /* A colour of the figures; one that is too dark for a dark page becomes lighter. */
  function colour(given) {
    const found = /^#([0-9a-f]{6})$/i.exec(given || "");
    if (!found) return dark() ? "#9aa5b4" : "#5b6675";
    const parts = [0, 2, 4].map((at) => parseInt(found[1].slice(at, at + 2), 16));
    const light = (0.299 * parts[0] + 0.587 * parts[1] + 0.114 * parts[2]) / 255;
    const wanted = 0.5;
    if (!dark() || light >= wanted) return given;
    const share = (wanted - light) / (1 - light);
    return `rgb(${parts.map((part) => Math.round(part + share * (255 - part))).join(",")})`;
  }

  system.addEventListener("change", apply);
  apply();
  Object.assign(bench, {colour, dark, themeButton: button, onTheme: (home, redraw) => redraws.set(home, redraw)});
})((window.implicitBench = window.implicitBench || {}));
