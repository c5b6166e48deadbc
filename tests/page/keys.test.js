// Keys of the page: their names, in which modes they work, and which belong to the focused field; colours; attributes.

import assert from "node:assert/strict";
import { test } from "node:test";
import { nameOf, steps } from "../../web_assets/js/attributes.js";
import { matching } from "../../web_assets/js/classes/picker.js";
import { classColor, isDark, PALETTE, STATE_COLORS, trackColor } from "../../web_assets/js/colors.js";
import { createKeys, KEYS } from "../../web_assets/js/keys.js";

/** Presses keys in a mode; `press("k", {target: …})` returns whether the page took it, `told` has the handlers' keys. */
function keysIn(mode, ...ids) {
  globalThis.document = { querySelector: () => null, activeElement: null, body: null };
  globalThis.HTMLInputElement = globalThis.HTMLTextAreaElement = class {};
  const [keys, told] = [createKeys(), []];
  let listener = null;
  keys.setMode(mode);
  keys.listen({ addEventListener: (_, fn) => (listener = fn) });
  keys.register(Object.fromEntries(ids.map((id) => [id, (key) => void told.push(`${id} ${key}`)])));
  const press = (key, { target = {}, code = "", ...more } = {}) => {
    const event = { key, code, defaultPrevented: false, composedPath: () => [target], ...more };
    event.preventDefault = () => (event.defaultPrevented = true);
    event.stopImmediatePropagation = () => {};
    listener(event);
    return event.defaultPrevented;
  };
  return { keys, press, told };
}

test("a key has its modifiers in one order, and letters in capitals", () => {
  const { press, told } = keysIn("annotate", "undo", "redo", "accept", "accept-all", "previous-of-track", "attribute");
  press("z", { ctrlKey: true });
  press("z", { metaKey: true, shiftKey: true }); // as on a Mac
  press(" ");
  press(" ", { shiftKey: true });
  press("P", { shiftKey: true });
  press("ø", { altKey: true, code: "KeyO" }); // as a Mac types Alt+O
  assert.deepEqual(told, [
    "undo Ctrl+Z",
    "redo Ctrl+Shift+Z",
    "accept Space",
    "accept-all Shift+Space",
    "previous-of-track Shift+P",
    "attribute Alt+O",
  ]);
});

test("a digit is the class on every layout, and a key that no handler has is the browser's", () => {
  const { press, told } = keysIn("annotate", "class", "track-class");
  assert.equal(press("é", { code: "Digit2" }), true);
  assert.equal(press("2", { code: "Digit2" }), true);
  assert.equal(press("x"), false);
  // with Shift that of the whole track, also where this types the digit
  assert.equal(press("@", { code: "Digit2", shiftKey: true }), true);
  assert.equal(press("2", { code: "Digit2", shiftKey: true }), true);
  assert.deepEqual(told, ["class 2", "class 2", "track-class 2", "track-class 2"]);
});

test("a key works in its own modes, and the newest handler has it", () => {
  const { keys, press, told } = keysIn("train", "reject", "draw-box");
  press("x");
  press("b");
  keys.setMode("annotate");
  const forget = keys.register({ reject: () => void told.push("newer") });
  press("x");
  forget();
  press("x");
  press("b");
  assert.deepEqual(told, ["newer", "reject X", "draw-box B"]);
  assert.throws(() => keys.register({ nothing() {} }), /no row 'nothing'/);
});

test("what is typed into a field belongs to it", () => {
  const { press } = keysIn("annotate", "accept", "reject", "undo", "attribute", "next-box", "regions");
  const [text, number, select, button] = [
    { tagName: "INPUT", type: "text" },
    { tagName: "INPUT", type: "number" },
    { tagName: "SELECT" },
    { tagName: "BUTTON" },
  ];
  assert.equal(press("x", { target: text }), false);
  assert.equal(press("z", { target: text, ctrlKey: true }), false, "undoes what was typed");
  assert.equal(press("F6", { target: text }), true);
  assert.equal(press("o", { target: text, altKey: true }), true, "a key of an attribute is pressed with Alt");
  // a number field needs no letters
  assert.equal(press("x", { target: number }), true);
  assert.equal(press(" ", { target: number }), true);
  assert.equal(press("z", { target: number, ctrlKey: true }), true);
  assert.equal(press("Tab", { target: number }), false);
  assert.equal(press("x", { target: select }), false);
  assert.equal(press("z", { target: select, ctrlKey: true }), true);
  assert.equal(press("Tab", { target: button }), false);
  assert.equal(press("x", { target: button }), true);
});

test("no two rows have the same key", () => {
  const all = KEYS.flatMap(({ keys }) => keys);
  assert.deepEqual(
    all.filter((key, i) => all.indexOf(key) !== i),
    [],
  );
});

test("a key that is held down acts once, but steps go on", () => {
  const { press, told } = keysIn("annotate", "accept", "next-frame");
  for (const repeat of [false, true, true]) {
    assert.equal(press(" ", { repeat }), true);
    press("n", { repeat });
  }
  assert.deepEqual(told, ["accept Space", "next-frame N", "next-frame N", "next-frame N"]);
});

test("a class has its own colour, or one by its place; an unknown one is grey", () => {
  const project = { classes: ["person", "chair"], class_styles: { chair: { colour: "#123456" } } };
  assert.equal(classColor(project, "chair"), "#123456");
  assert.equal(classColor(project, "dog"), trackColor(null));
  assert.notEqual(classColor(project, "person"), classColor(project, "dog"));
  assert.notEqual(trackColor(7), trackColor(8));
  assert.deepEqual(["#123456", "#ffe14d"].map(isDark), [true, false]);
});

test("a key goes through the few values of an attribute; another one is typed", () => {
  assert.deepEqual(steps({ kind: "choice", choices: ["sitting", "standing"] }), ["sitting", "standing"]);
  assert.deepEqual(steps({ kind: "boolean" }).map(nameOf), ["yes", "no"]);
  assert.deepEqual(steps({ kind: "integer", minimum: 0.5, maximum: 3 }), [1, 2, 3]);
  assert.equal(steps({ kind: "integer", minimum: 0, maximum: 20 }), null);
  assert.equal(steps({ kind: "number", minimum: 0, maximum: 2 }), null);
});

test("the colours of 20 classes and of what is proposed are far apart", () => {
  // OKLab, after B. Ottosson, 2020
  const lab = (/** @type {string} */ color) => {
    const [r, g, b] = [1, 3, 5].map((at) => {
      const share = Number.parseInt(color.slice(at, at + 2), 16) / 255;
      return share <= 0.04045 ? share / 12.92 : ((share + 0.055) / 1.055) ** 2.4;
    });
    const l = Math.cbrt(0.4122214708 * r + 0.5363325363 * g + 0.0514459929 * b);
    const m = Math.cbrt(0.2119034982 * r + 0.6806995451 * g + 0.1073969566 * b);
    const s = Math.cbrt(0.0883024619 * r + 0.2817188376 * g + 0.6299787005 * b);
    return [
      0.2104542553 * l + 0.793617785 * m - 0.0040720468 * s,
      1.9779984951 * l - 2.428592205 * m + 0.4505937099 * s,
      0.0259040371 * l + 0.7827717662 * m - 0.808675766 * s,
    ];
  };
  const all = [...PALETTE, STATE_COLORS.proposed].map(lab);
  assert.equal(all.length, 21);
  all.forEach((a, i) => {
    for (const b of all.slice(i + 1)) assert.ok(Math.hypot(a[0] - b[0], a[1] - b[1], a[2] - b[2]) > 0.12);
  });
});

test("classes are found by a part of their names, those that begin with it first", () => {
  const names = ["person", "car", "tram", "Trailer", "motor car"];
  assert.deepEqual(matching(names, " car"), ["car", "motor car"]);
  assert.deepEqual(matching(names, "TR"), ["tram", "Trailer"]);
  assert.deepEqual(matching(names, ""), names);
  assert.deepEqual(matching(names, "bus"), []);
});
