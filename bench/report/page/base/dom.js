/* Builds elements. Text only ever becomes text, and an address must lead into the results folder: nothing that a record
   says is read as markup or as code. */
(function (bench) {
  "use strict";

  const PICTURE = /^data:image\/(png|gif|webp|jpeg);base64,[A-Za-z0-9+/=]*$/;
  const WITHIN = /^(runs|paper|sweeps)\/[A-Za-z0-9_.~%/-]*$/;

  /* The address, if it is a place of this page, a file of the results folder or a picture that is written into the page. */
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
    add(made, children);
    return made;
  }

  function set(made, name, value) {
    if (value === null || value === undefined || value === false) return;
    if (typeof value === "function") made.addEventListener(name, value);
    else if (name === "href" || name === "src") {
      const address = safeAddress(value);
      if (address !== null) made.setAttribute(name, address);
    } else if (name === "checked" || name === "value" || name === "disabled" || name === "open") made[name] = value;
    else if (
      /^(aria-[a-z]+|data-[a-z]+|id|role|type|title|alt|for|loading|scope|colspan|rowspan|width|height|tabindex|style|placeholder|download|autocomplete|name|lang)$/.test(
        name,
      )
    )
      made.setAttribute(name, value === true ? "" : String(value));
    else throw new Error(`dom.js knows no property ${name}`);
  }

  function add(parent, children) {
    for (const child of children.flat(Infinity)) {
      if (child === null || child === undefined || child === false || child === "") continue;
      parent.append(child instanceof Node ? child : document.createTextNode(String(child)));
    }
  }

  /* Replaces all children of an element. */
  function fill(parent, ...children) {
    parent.replaceChildren();
    add(parent, children);
    return parent;
  }

  /* Text in which the words between asterisks are strong. */
  function emphasised(text) {
    return String(text)
      .split("*")
      .map((part, place) => (place % 2 ? element("strong", null, part) : part));
  }

  /* A name that may be broken behind its dots and underscores. */
  const breakable = (text) =>
    String(text)
      .split(/(?<=[._])/)
      .flatMap((part, place) => (place ? [element("wbr"), part] : [part]));

  /* A button that copies a text. */
  function copyButton(text, label) {
    return element(
      "button.small",
      {
        type: "button",
        "aria-label": label,
        click: (event) => {
          const said = (word) => (event.target.textContent = word);
          const area = element("textarea.hidden", {value: text, "aria-hidden": "true"});
          document.body.append(area);
          area.select();
          said(document.execCommand("copy") ? "Copied" : "Press Ctrl+C");
          area.remove();
          setTimeout(() => said("Copy"), 1500);
        },
      },
      "Copy",
    );
  }

  bench.dom = {element, fill, emphasised, breakable, copyButton, safeAddress};
})((window.implicitBench = window.implicitBench || {}));
