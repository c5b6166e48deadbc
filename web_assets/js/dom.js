/** Makes elements. Nothing here parses HTML, so no text can become markup. */

const SVG = "http://www.w3.org/2000/svg";

/**
 * An element: h("button.primary", { onclick: fn, disabled: true }, "Save"), h("p", "Text"). The tag has the classes behind
 * it, and attributes can be left out. A function becomes a listener and true an empty attribute; null and false are left
 * out; `value` and `checked` are set as properties.
 *
 * @template {string} T
 * @param {T} tag
 * @param {Attributes | Children} [first] attributes, or the first child.
 * @param {...Children} children
 * @returns {HTMLElementTagNameMap[TagOf<T, HTMLElementTagNameMap>]}
 */
export function h(tag, first, ...children) {
  return fill(document.createElement(tag.split(".")[0]), tag, first, children);
}

/**
 * The same in SVG.
 *
 * @template {string} T
 * @param {T} tag
 * @param {Attributes | Children} [first]
 * @param {...Children} children
 * @returns {SVGElementTagNameMap[TagOf<T, SVGElementTagNameMap>]}
 */
export function s(tag, first, ...children) {
  return fill(document.createElementNS(SVG, tag.split(".")[0]), tag, first, children);
}

/** @returns {any} the element, of the type that its tag says. */
function fill(
  /** @type {Element} */ element,
  /** @type {string} */ tag,
  /** @type {Attributes | Children} */ first,
  /** @type {Children[]} */ children,
) {
  const names = tag.split(".").slice(1).join(" ");
  if (names) element.setAttribute("class", names);
  const isChild = first?.constructor !== Object;
  if (!isChild) for (const [name, value] of Object.entries(first)) setAttribute(element, name, value);
  element.append(...present(isChild ? [/** @type {Children} */ (first), ...children] : children));
  return element;
}

/** The children that are there, out of their lists. @returns {(Node | string)[]} */
const present = (/** @type {Children} */ children) => {
  if (Array.isArray(children)) return children.flatMap(present);
  return children === null || children === undefined || children === false ? [] : [children];
};

function setAttribute(
  /** @type {Element} */ element,
  /** @type {string} */ name,
  /** @type {AttributeValue} */ value,
) {
  if (value === null || value === undefined || value === false) return;
  if (typeof value === "function") listen(element, name.slice(2), /** @type {EventListener} */ (value));
  else if (name === "value" || name === "checked") Object.assign(element, { [name]: value });
  else element.setAttribute(name, value === true ? "" : String(value));
}

/** What the elements made here do on events. @type {WeakMap<Node, Record<string, EventListener>>} */
const listeners = new WeakMap();

function listen(/** @type {Element} */ element, /** @type {string} */ type, /** @type {EventListener} */ fn) {
  const own = listeners.get(element) ?? {};
  listeners.set(element, own);
  if (!own[type]) element.addEventListener(type, (event) => own[type](event));
  own[type] = fn;
}

/**
 * Makes these the children of an element, in place: a child of the same tag and `data-key` that is there already stays,
 * and becomes like the new one. So a click counts although the list is drawn again between press and release, and
 * focus, tooltips and open lists stay. The new element is then not shown: what a listener needs of it, it takes from the
 * event, and an element that somebody keeps needs a key of its own.
 */
export function patch(/** @type {Element} */ host, /** @type {Children[]} */ ...children) {
  const left = [...host.childNodes];
  const nodes = present(children).map((child) => {
    const fresh = typeof child === "string" ? document.createTextNode(child) : child;
    const old = left.find((node) => node === fresh) ?? left.find((node) => isSame(node, fresh));
    if (!old) return fresh;
    left.splice(left.indexOf(old), 1);
    if (old !== fresh) become(old, fresh);
    return old;
  });
  for (const old of left) old.remove();
  nodes.forEach((node, i) => {
    if (host.childNodes[i] !== node) host.insertBefore(node, host.childNodes[i] ?? null);
  });
}

const keyOf = (/** @type {Node} */ node) => (node instanceof Element ? node.getAttribute("data-key") : null);
const isSame = (/** @type {Node} */ a, /** @type {Node} */ b) => a.nodeName === b.nodeName && keyOf(a) === keyOf(b);

function become(/** @type {Node} */ old, /** @type {Node} */ fresh) {
  if (!(old instanceof Element && fresh instanceof Element)) {
    if (old.nodeValue !== fresh.nodeValue) old.nodeValue = fresh.nodeValue;
    return;
  }
  for (const { name } of [...old.attributes]) if (!fresh.hasAttribute(name)) old.removeAttribute(name);
  for (const { name, value } of fresh.attributes) if (old.getAttribute(name) !== value) old.setAttribute(name, value);
  const [mine, wanted] = [listeners.get(old) ?? {}, listeners.get(fresh) ?? {}];
  for (const type of Object.keys(mine)) mine[type] = () => {};
  for (const [type, fn] of Object.entries(wanted)) listen(old, type, fn);
  patch(old, ...fresh.childNodes);
  for (const name of ["value", "checked"]) {
    const [was, is] = [Reflect.get(old, name), Reflect.get(fresh, name)];
    if (is !== undefined && was !== is) Reflect.set(old, name, is);
  }
}

const GLYPHS = {
  undo: "M6 4 3 7l3 3M3 7h6.5a3.5 3.5 0 0 1 0 7H7",
  redo: "M10 4l3 3-3 3M13 7H6.5a3.5 3.5 0 0 0 0 7H9",
  previous: "M10 3 5 8l5 5",
  next: "M6 3l5 5-5 5",
  up: "M3 10l5-5 5 5",
  down: "M3 6l5 5 5-5",
  edit: "M3 13l.6-2.8L11 2.8l2.2 2.2-7.4 7.4ZM9.5 4.3l2.2 2.2",
  plus: "M8 3v10M3 8h10",
  close: "M4 4l8 8M12 4l-8 8",
  trash: "M3 4.5h10M6.5 4.5V3h3v1.5M4.5 4.5 5.2 13h5.6l.7-8.5",
  fit: "M3 6V3h3M10 3h3v3M13 10v3h-3M6 13H3v-3",
  folder: "M2 4.5h4l1.3 1.5H14v7H2Z",
  theme: "M8 2.5a5.5 5.5 0 1 0 0 11ZM8 2.5a5.5 5.5 0 0 1 0 11",
  help: "M6 6.2A2 2 0 1 1 8 8.3v1.2M8 12.2v.1M8 1.5a6.5 6.5 0 1 0 0 13 6.5 6.5 0 0 0 0-13Z",
  check: "M3 8.5 6.5 12 13 4.5",
  warning: "M8 2.5 14.5 13.5h-13ZM8 6.5v3.5M8 12v.1",
  more: "M4 8a1 1 0 1 0-2 0 1 1 0 1 0 2 0M9 8a1 1 0 1 0-2 0 1 1 0 1 0 2 0M14 8a1 1 0 1 0-2 0 1 1 0 1 0 2 0",
  download: "M8 2.5v8M4.5 7.5 8 11l3.5-3.5M3 13.5h10",
  drag: "M2.5 2.5h2M6.5 2.5h2M10.5 2.5h1M2.5 2.5v2M2.5 6.5v2M2.5 10.5v1h2M11.5 2.5v2M8 8l6 2.2-2.6 1.2L10.2 14Z",
  box: "M8 1.8 13.5 4.7v6.6L8 14.2 2.5 11.3V4.7ZM2.5 4.7 8 7.6l5.5-2.9M8 7.6v6.6",
  track: "M1.8 5.5h3.4v5H1.8ZM7 5.5h2.6v5H7ZM11.6 5.5h2.6v5h-2.6ZM3.5 3h9M10.8 1.5 12.5 3l-1.7 1.5",
  lock: "M4 7.5h8V14H4ZM5.5 7.5V5a2.5 2.5 0 0 1 5 0v2.5",
};

/** A decorative line icon of 16 x 16. The control around it needs its own label. */
export function glyph(/** @type {keyof typeof GLYPHS} */ name) {
  return s("svg", { class: "glyph", viewBox: "0 0 16 16", "aria-hidden": "true" }, s("path", { d: GLYPHS[name] }));
}

/**
 * A button: button("Save", save, { class: "primary" }).
 *
 * @param {Children} content
 * @param {((event: MouseEvent) => unknown) | null} onclick
 * @param {Attributes} [more]
 */
export function button(content, onclick, more = {}) {
  return h("button", { type: "button", onclick: onclick ?? undefined, ...more }, content);
}

/** A button that shows only an icon; the label is its tooltip and its accessible name. */
export function iconButton(
  /** @type {keyof typeof GLYPHS} */ icon,
  /** @type {string} */ label,
  /** @type {(event: MouseEvent) => unknown} */ onclick,
  /** @type {Attributes} */ more = {},
) {
  return button(glyph(icon), onclick, { class: "icon quiet", title: label, "aria-label": label, ...more });
}

/** A list of texts. */
export const bullets = (/** @type {string[]} */ texts, /** @type {Attributes} */ more = {}) =>
  h(
    "ul",
    more,
    texts.map((text) => h("li", text)),
  );

/** What a page that has nothing to show says, below a title if it has one, and a link to what to do. */
export const nothing = (
  /** @type {string} */ title,
  /** @type {string} */ text,
  /** @type {string} */ href,
  /** @type {string} */ action,
) => h("div.empty", title && h("h2", title), h("p", text), h("a.button", { href }, action));

/** 1 -> "1 frame", 2 -> "2 frames", "2 boxes". */
export function count(
  /** @type {number} */ number,
  /** @type {string} */ word,
  /** @type {string} */ plural = word.endsWith("x") ? `${word}es` : `${word}s`,
) {
  return `${number.toLocaleString("en")} ${number === 1 ? word : plural}`;
}

/** A time, milliseconds since 1970, as "5 Jan 2026, 12:00". */
export const dateOf = (/** @type {number} */ ms) =>
  new Date(ms).toLocaleString([], { dateStyle: "medium", timeStyle: "short" });

/** Leaves the text or number field within `host` that has the focus, which stores what was typed in it. */
export function leaveField(/** @type {Element} */ host = document.body) {
  const field = document.activeElement;
  const isTyped = field instanceof HTMLInputElement || field instanceof HTMLTextAreaElement;
  if (isTyped && host.contains(field)) field.blur();
}

/** An element of index.html. */
export function elementById(/** @type {string} */ id) {
  const element = document.getElementById(id);
  if (element === null) throw new Error(`the page has no element #${id}`);
  return element;
}
