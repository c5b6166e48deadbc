// Keys of the page: their names, in which modes they work, and which belong to the focused field; colours; attributes.

import assert from "node:assert/strict";
import { test } from "node:test";
import { nameOf, steps } from "../../web_assets/js/attributes.js";
import { classColor, isDark, trackColor } from "../../web_assets/js/colors.js";
import { createKeys, KEYS } from "../../web_assets/js/keys.js";

/** Presses keys in a mode; `press("k", {target: …})` returns whether the page took it, `told` has the handlers' keys. */
function keysIn(mode, ...ids) {
  globalThis.document = { querySelector: () => null, activeElement: null, body: null };
  globalThis.HTMLInputElement = globalThis.HTMLTextAreaElement = class {};
  const [keys, told] = [createKeys(), []];
  let listener = null;
  keys.setMode(mode);
  keys.listen({ addEventListener: (_, fn) => (listener = fn) });
  keys.register(Object.fromEntries(ids.map((id) => [id, (_, key) => void told.push(`${id} ${key}`)])));
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
  const { press, told } = keysIn("review", "undo", "redo", "accept", "accept-all", "previous-of-track", "attribute");
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
  const { press, told } = keysIn("review", "class", "track-class");
  assert.equal(press("é", { code: "Digit2" }), true);
  assert.equal(press("2", { code: "Digit2" }), true);
  assert.equal(press("x"), false);
  // with Shift that of the whole track, also where this types the digit
  assert.equal(press("@", { code: "Digit2", shiftKey: true }), true);
  assert.equal(press("2", { code: "Digit2", shiftKey: true }), true);
  assert.deepEqual(told, ["class 2", "class 2", "track-class 2", "track-class 2"]);
});

test("a key works in its own modes, and the newest handler has it", () => {
  const { keys, press, told } = keysIn("label", "reject", "box-kind", "draw-box");
  press("x");
  press("b");
  keys.setMode("review");
  const forget = keys.register({ reject: () => void told.push("newer") });
  press("x");
  forget();
  press("x");
  press("b");
  assert.deepEqual(told, ["box-kind B", "newer", "reject X", "draw-box B"]);
  assert.throws(() => keys.register({ nothing() {} }), /no row 'nothing'/);
});

test("what is typed into a field belongs to it", () => {
  const { press } = keysIn("review", "accept", "reject", "undo", "attribute", "next-box", "regions");
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

test("no two rows have the same key in a mode", () => {
  for (const mode of ["label", "review"]) {
    const all = KEYS.filter(({ modes }) => modes === null || modes.includes(mode)).flatMap(({ keys }) => keys);
    assert.deepEqual(
      all.filter((key, i) => all.indexOf(key) !== i),
      [],
    );
  }
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
