/**
 * The areas of Annotate: the images, the 3D view, and the object. Their borders are dragged, and a key gives the main
 * place to the next area. The browser keeps both.
 */

import { h } from "../dom.js";

const KEPT = "areas";
/** In the order in which they come to the main place. */
const ORDER = ["image", "scene", "object"];
/** By an arrow key. */
const STEP_PX = 16;
/** The smallest size of a place. */
const LEAST_PX = { x: 180, y: 120 };

/**
 * The borders between the places. Each sets the size of one track of the grid (annotate.css), from which it lies in the
 * direction `side`; `others` are the tracks that give way.
 *
 * @type {[string, { text: string, axis: "x" | "y", track: number, side: 1 | -1, others: number[] }][]}
 */
const BORDERS = [
  ["lists", { text: "Width of the lists", axis: "x", track: 0, side: 1, others: [1, 2] }],
  ["first", { text: "Width of the main place", axis: "x", track: 1, side: 1, others: [2] }],
  ["third", { text: "Height of the lower place", axis: "y", track: 2, side: -1, others: [0] }],
  ["numbers", { text: "Width of the numbers", axis: "x", track: 3, side: -1, others: [1, 2] }],
];

/** What the browser has kept, as far as it is one. */
export function readAreas() {
  try {
    return Object.fromEntries(
      Object.entries(JSON.parse(localStorage.getItem(KEPT) ?? "{}") ?? {}).filter(([name, value]) =>
        name === "main" ? ORDER.includes(value) : /^[\d.]+%$/.test(value),
      ),
    );
  } catch {
    return {};
  }
}

export function createAreas(/** @type {HTMLElement} */ root) {
  /** The area in the main place, and the sizes that were set, percent of the whole. @type {Record<string, string>} */
  const kept = { main: ORDER[0], ...readAreas() };
  root.append(...BORDERS.map(handleOf));
  show();

  function show() {
    root.dataset.main = kept.main;
    for (const [name] of BORDERS) root.style.setProperty(`--${name}`, kept[name] ?? null);
  }

  function keep() {
    localStorage.setItem(KEPT, JSON.stringify(kept));
    show();
  }

  /** @param {typeof BORDERS[number]} border */
  function handleOf([name, { text, axis, track, side, others }]) {
    /** The pointer's place and the size of each track when a drag began. @type {{ at: number, sizes: number[] } | null} */
    let start = null;
    const placeOf = (/** @type {PointerEvent} */ event) => (axis === "x" ? event.clientX : event.clientY);

    function sizesNow() {
      const { gridTemplateColumns, gridTemplateRows } = getComputedStyle(root);
      return (axis === "x" ? gridTemplateColumns : gridTemplateRows).split(" ").map(Number.parseFloat);
    }

    function move(/** @type {number[]} */ sizes, /** @type {number} */ byPx) {
      const room = others.reduce((sum, other) => sum + sizes[other] - LEAST_PX[axis], 0);
      const size = Math.min(Math.max(sizes[track] + side * byPx, LEAST_PX[axis]), sizes[track] + room);
      const whole = axis === "x" ? root.clientWidth : root.clientHeight;
      kept[name] = `${((100 * size) / (whole - 2 * Number.parseFloat(getComputedStyle(root).padding))).toFixed(2)}%`;
      handle.setAttribute("aria-valuenow", String(Math.round(Number.parseFloat(kept[name]))));
      show();
    }

    const handle = h("div", {
      class: `border ${name}`,
      role: "separator",
      tabindex: 0,
      "aria-label": text,
      "aria-orientation": axis === "x" ? "vertical" : "horizontal",
      "aria-valuenow": Math.round(Number.parseFloat(kept[name] ?? "50")),
      title: `${text}: drag; a double click resets it`,
      "data-testid": `border-${name}`,
      onpointerdown(event) {
        if (event.button !== 0) return;
        event.preventDefault();
        handle.setPointerCapture(event.pointerId);
        start = { at: placeOf(event), sizes: sizesNow() };
      },
      onpointermove: (event) => start && move(start.sizes, placeOf(event) - start.at),
      onlostpointercapture() {
        if (start) keep();
        start = null;
      },
      onkeydown(event) {
        const by = { ArrowLeft: -1, ArrowUp: -1, ArrowRight: 1, ArrowDown: 1 }[event.key];
        if (by === undefined) return;
        event.preventDefault();
        move(sizesNow(), by * STEP_PX);
        keep();
      },
      ondblclick() {
        delete kept[name];
        keep();
      },
    });
    return handle;
  }

  return {
    /** Gives the main place to the next area. */
    swap() {
      kept.main = ORDER[(ORDER.indexOf(kept.main) + 1) % ORDER.length];
      keep();
    },
  };
}
