/* Light and dark: as the system has it, or as the reader chose; and colours that stay visible on either. */
(function (bench) {
  "use strict";

  const MODES = {auto: ["◐", "as the system"], light: ["☀", "light"], dark: ["☾", "dark"]};
  const KEY = "implicit-bench-theme";
  const system = window.matchMedia("(prefers-color-scheme: dark)");
  const redraws = new Map();
  let mode = kept();

  function kept() {
    try {
      return Object.hasOwn(MODES, localStorage.getItem(KEY)) ? localStorage.getItem(KEY) : "auto";
    } catch {
      return "auto"; // a browser that keeps nothing for files
    }
  }

  const dark = () => (mode === "auto" ? system.matches : mode === "dark");

  function apply() {
    document.documentElement.dataset.theme = dark() ? "dark" : "light";
    for (const [home, redraw] of redraws) home.isConnected ? redraw() : redraws.delete(home);
  }

  function themeButton() {
    const button = bench.dom.element("button.theme", {type: "button", click: change});
    const next = () => Object.keys(MODES)[(Object.keys(MODES).indexOf(mode) + 1) % 3];
    const name = () => {
      button.textContent = MODES[mode][0];
      button.title = `Colours: ${MODES[mode][1]}. Change to ${MODES[next()][1]}.`;
      button.setAttribute("aria-label", button.title);
    };
    function change() {
      mode = next();
      try {
        localStorage.setItem(KEY, mode);
      } catch {
        // kept until the page is closed
      }
      name();
      apply();
    }
    name();
    return button;
  }

  /* A colour of the figures; one that is too dark for a dark page becomes lighter. */
  function colour(given) {
    if (!/^#[0-9a-f]{6}$/i.test(given || "")) return dark() ? "#9aa5b4" : "#5b6675";
    const parts = [1, 3, 5].map((at) => parseInt(given.slice(at, at + 2), 16));
    const light = (0.299 * parts[0] + 0.587 * parts[1] + 0.114 * parts[2]) / 255;
    const share = dark() ? Math.max(0, (0.5 - light) / (1 - light)) : 0;
    return `rgb(${parts.map((part) => Math.round(part + share * (255 - part))).join(",")})`;
  }

  system.addEventListener("change", apply);
  apply();
  Object.assign(bench, {colour, themeButton, onTheme: (home, redraw) => redraws.set(home, redraw)});
})((window.implicitBench = window.implicitBench || {}));
