/* Builds elements. Text stays text, and an address must lead into the results folder, so that nothing in a record is read
   as markup or code. */
(function (bench) {
  "use strict";

  const PICTURE = /^data:image\/(png|gif|webp|jpeg);base64,[A-Za-z0-9+/=]*$/;
  const WITHIN = /^(runs|paper|sweeps|page\/shipped)\/[A-Za-z0-9_.~%/-]*$/;
  const ATTRIBUTE =
    /^(aria-[a-z]+|data-[a-z]+|id|role|type|title|alt|loading|scope|colspan|width|height|tabindex|placeholder)$/;

  /* The address if it is a view of this page, a file of the results folder or an embedded picture; else null. */
  function safeAddress(address) {
    const text = String(address);
    if (text.startsWith("#") || PICTURE.test(text)) return text;
    const climbs = text.split("/").some((part) => /^(\.|%2e){2}$/i.test(part));
    return WITHIN.test(text) && !climbs ? text : null;
  }

  /* An element: element("a.name", {href: "#/"}, "text", child). Functions among the properties are listeners. */
  function element(kind, properties, ...children) {
    const [tag, ...classes] = kind.split(".");
    const made = document.createElement(tag);
    if (classes.length) made.className = classes.join(" ");
    for (const [name, value] of Object.entries(properties || {})) set(made, name, value);
    return fill(made, children);
  }

  function set(made, name, value) {
    if (value === null || value === undefined || value === false) return;
    if (typeof value === "function") made.addEventListener(name, value);
    else if (name === "href" || name === "src") {
      const address = safeAddress(value);
      if (address !== null) made.setAttribute(name, address);
    } else if (["checked", "value", "disabled", "open"].includes(name)) made[name] = value;
    else if (ATTRIBUTE.test(name)) made.setAttribute(name, value === true ? "" : String(value));
    else throw new Error(`dom.js knows no property ${name}`);
  }

  /* Replaces all children of an element; those that are missing, false or empty are left out. */
  function fill(parent, ...children) {
    const shown = children.flat(Infinity).filter((child) => ![null, undefined, false, ""].includes(child));
    parent.replaceChildren(...shown.map((child) => (child instanceof Node ? child : String(child))));
    return parent;
  }

  const soft = (...children) => element("span.soft", null, children);
  const section = (title, ...children) => element("section", null, element("h2", null, title), children);
  const details = (title, ...children) => element("details", null, element("summary", null, title), children);
  const list = (items) => element("ul", null, items.map((item) => element("li", null, item)));

  /* Names and values, a line each. */
  const facts = (rows) =>
    element("dl.facts", null, rows.map(([name, value]) =>
      element("div", null, element("dt", null, name), element("dd", null, value))));

  /* Shows the value of a promise by `show`, or the message of its error. */
  function later(promise, show) {
    const home = element("div", null, element("p.soft", null, "Loading …"));
    promise.then((data) => fill(home, show(data)), (error) => fill(home, element("p.note", null, error.message)));
    return home;
  }

  /* Buttons, one of which is pressed; `names` by key. */
  function choice(label, names, pressed, press) {
    const buttons = Object.entries(names).map(([key, name]) => {
      const click = (event) => {
        for (const button of buttons) button.setAttribute("aria-pressed", String(button === event.currentTarget));
        press(key);
      };
      return element("button", {type: "button", "aria-pressed": String(key === pressed), click}, name);
    });
    return element("div.switch", {role: "group", "aria-label": label}, buttons);
  }

  /* Text in which the words between asterisks are strong. */
  const emphasised = (text) =>
    String(text).split("*").map((part, index) => (index % 2 ? element("strong", null, part) : part));

  /* A name in monospace that may be broken after its dots and underscores. */
  const code = (name) =>
    element("code", null, String(name).split(/(?<=[._])/).flatMap((part, n) => (n ? [element("wbr"), part] : part)));

  /* Lines of code with a button that copies them. */
  function copied(text, label) {
    const click = ({currentTarget: button}) => {
      const area = element("textarea.unseen", {value: text, "aria-hidden": "true"});
      document.body.append(area);
      area.select();
      button.textContent = document.execCommand("copy") ? "Copied" : "Press Ctrl+C";
      area.remove();
      setTimeout(() => (button.textContent = "Copy"), 1500);
    };
    const button = element("button", {type: "button", "aria-label": label, click}, "Copy");
    return element("div.code", null, element("pre", {tabindex: 0}, text), button);
  }

  Object.assign(bench, {
    dom: {element, fill, soft, section, details, list, facts, later, choice, emphasised, code, copied, safeAddress},
  });
})((window.implicitBench = window.implicitBench || {}));
