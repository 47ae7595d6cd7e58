/* Writes numbers for readers, as bench/records/format.py does: three significant digits, ∞ for infinite, – for missing. */
(function (bench) {
  "use strict";

  const MISSING = "–";

  function number(x, factor = 1) {
    if (typeof x === "string") return x;
    if (x === null || x === undefined) return MISSING;
    const value = x * factor;
    if (Number.isNaN(value)) return "nan";
    if (!Number.isFinite(value)) return value < 0 ? "-∞" : "∞";
    if (value === 0) return "0";
    const [mantissa, exponent] = value.toExponential(2).split("e");
    const power = Number(exponent);
    if (power >= -4 && power < 6) return Number(`${mantissa}e${power}`).toFixed(Math.max(0, 2 - power));
    return `${mantissa}e${power}`;
  }

  function count(n) {
    if (n === null || n === undefined || !Number.isFinite(n)) return number(n);
    if (Math.abs(n) < 999.5) return n.toFixed(0);
    const power = Math.min(Math.floor(Number(n.toExponential(2).split("e")[1]) / 3), 5);
    return number(n, 1000 ** -power) + " kMGTP"[power];
  }

  function size(n) {
    if (n === null || n === undefined || !Number.isFinite(n)) return number(n);
    const text = count(n);
    return /\d$/.test(text) ? `${text} B` : `${text.slice(0, -1)} ${text.slice(-1)}B`;
  }

  function seconds(x) {
    if (x === null || x === undefined || !Number.isFinite(x)) return number(x);
    if (Math.abs(x) < 1 && x !== 0) return `${number(x, 1000)} ms`;
    if (Math.abs(x) < 120) return `${number(x)} s`;
    return Math.abs(x) < 7200 ? `${number(x, 1 / 60)} min` : `${number(x, 1 / 3600)} h`;
  }

  /* A time in seconds since 1970 as a date with hours and minutes, in UTC. */
  function date(x) {
    return x === null ? MISSING : new Date(1000 * x).toISOString().slice(0, 16).replace("T", " ");
  }

  const plural = (n, word) => `${n.toLocaleString("en")} ${word}${n === 1 ? "" : "s"}`;

  /* A label's "(x1000)" with the sign of multiplication. */
  const label = (text) => text[0].toUpperCase() + text.slice(1).replace("(x1000)", "× 1000");

  bench.format = {number, count, size, seconds, date, plural, label, MISSING};
})((window.implicitBench = window.implicitBench || {}));
