/**
 * The key table, and the listener that calls its handlers.
 *
 * A row defines what a key does; modes register handlers by the row's id. While a row has no handler, the browser (or
 * the focused 2D editor) gets the key. The listener runs in the capture phase, also in the 3D view's iframe, so that keys
 * work wherever the focus is. Keys typed into a text field belong to the field. A key that does not belong to its field
 * leaves it, so that what was typed is stored before the handler runs.
 *
 * A key's name has its modifiers in the order Ctrl+Alt+Shift (Cmd counts as Ctrl), then a letter in capitals, a digit,
 * another character as typed (`?`, `+`), or the name from KeyboardEvent.key. The space bar is "Space".
 */

import { leaveField } from "./dom.js";

/** The group whose keys work in all modes; the others are those of Annotate. */
const EVERYWHERE = "Everywhere";
/** What happens again and again while its key is held down. */
const REPEATED = /^(undo|redo|(next|previous)-(frame|box)|points-.*)$/;

/** @type {KeyRow[]} */
export const KEYS = [
  ...rows(EVERYWHERE, [
    ["undo", ["Ctrl+Z"], "Undo"],
    ["redo", ["Ctrl+Shift+Z", "Ctrl+Y"], "Redo"],
    ["help", ["?"], "Show this table"],
    ["regions", ["F6"], "Move the focus to the top bar and back"],
  ]),
  ...rows("Frames and boxes", [
    ["next-frame", ["N", "PageDown"], "Next frame"],
    ["previous-frame", ["P", "PageUp"], "Previous frame"],
    ["go-to-frame", ["Ctrl+G"], "Go to a frame by its number"],
    ["next-camera", ["K"], "Next camera of this moment: first those that see the selected object, the best first"],
    ["previous-camera", ["Shift+K"], "Previous camera of this moment"],
    ["timeline", ["L"], "Fold and unfold the timeline"],
    ["next-box", ["Tab"], "Next box"],
    ["previous-box", ["Shift+Tab"], "Previous box"],
    ["class", digits(""), "Class", ["1", "…", "9"]],
    ["class-search", ["/"], "Class, from all of them, with a search"],
    [
      "attribute",
      alt("0123456789ABCDEFGHIJKLMNOPQRSTUVWXYZ"),
      "Next value of the attribute with this key, or the class with it (set the keys in the class editor)",
      ["Alt", "its key"],
    ],
    ["turn", ["F"], "Turn the 3D box: it faces the other way"],
    ["turn-quarter", ["Shift+F"], "Turn its heading by 90°; length and width are swapped"],
    ["delete", ["Delete", "Backspace"], "Delete", ["Del"]],
    ["cancel", ["Escape"], "Cancel the drag, then deselect"],
    ["finalise", ["Ctrl+Enter"], "Finalise the frame"],
  ]),
  ...rows("Boxes", [
    ["accept", ["Space", "Enter"], "Accept, then go to the next: of the queue, or else of this frame", ["Space"]],
    [
      "accept-all",
      ["Shift+Space"],
      "Accept all open boxes of the frame; in the queue, go to its next frame",
      ["Shift", "Space"],
    ],
    ["reject", ["X"], "Reject"],
    ["refit", ["G"], "Fit again from this box"],
    ["gizmo-translate", ["T"], "Move with the gizmo"],
    ["gizmo-rotate", ["R"], "Turn with the gizmo"],
    ["gizmo-off", ["Y"], "Hide the gizmo"],
    ["draw-box", ["B", "Insert"], "New box: drag on the image (also without this key)", ["B"]],
    ["copy-previous", ["C"], "Copy boxes from the previous frame"],
    ["teach", ["D"], "Pseudo-views, with the 2D boxes that teach the detectors, or views along the box"],
    ["next-whole-box", ["W"], "Show another whole box (dashed) for an object whose visible part is drawn"],
  ]),
  ...rows("Tracks", [
    ["follow", ["V"], "Follow this reviewed or new box through the recording"],
    ["follow-back", ["Shift+V"], "Follow it backward"],
    ["follow-all", ["J"], "Follow all reviewed boxes of this frame"],
    ["follow-all-back", ["Shift+J"], "Follow them backward"],
    ["sheet", ["S"], "Contact sheet of this object's track"],
    ["copy-next", ["Shift+C"], "Copy this box to the next frame"],
    ["track-split", ["E"], "Split the track here: from this frame on, it gets a new number"],
    ["track-merge", ["Shift+M"], "Merge the track with another one"],
    ["track-class", digits("Shift+"), "Class of the whole track", ["Shift", "1", "…", "9"]],
    ["track-size", ["Z"], "One size for the whole track"],
    ["track-fill", ["I"], "Fill the track's gaps beside this box"],
    ["track-still", ["A"], "Say that the track stands still, with one box for all frames, or that it moves"],
    ["track-delete", ["Shift+Delete", "Shift+Backspace"], "Delete the track from this frame on", ["Shift", "Del"]],
    ["next-of-track", ["Shift+N"], "Next frame of this object"],
    ["previous-of-track", ["Shift+P"], "Previous frame of this object"],
  ]),
  ...rows("View", [
    ["areas", ["Q"], "The main place for the next area: image, 3D view, object"],
    ["top-view", ["M"], "Top view (a map) or 3D view"],
    ["points-larger", ["+", "="], "Larger points", ["+"]],
    ["points-smaller", ["-"], "Smaller points"],
    ["look-box", ["O"], "3D view: look at the selected box, and turn around it (or double-click it)"],
    ["hide-ground", ["H"], "3D view: hide the ground"],
    ["unlabelled", ["U"], "Highlight what nobody labelled; again: box the next of it"],
    ["fit", ["0", "Home"], "Fit the pictures to their panels"],
  ]),
  ...rows("2D boxes", [
    ["nudge", arrows(["", "Shift+"]), "Move the box by 1 px, with Shift by 10", ["← ↑ → ↓"]],
    ["nudge-size", arrows(["Alt+", "Alt+Shift+"]), "Move its right or lower edge", ["Alt", "← ↑ → ↓"]],
    // the 2D editor handles these itself
    ["editor-zoom", [], "Zoom about the pointer", ["Wheel"]],
    ["editor-force", [], "Draw a new box over a selected one", ["Shift", "drag"]],
    ["editor-pan", [], "Pan (also with two fingers)", ["Middle button", "drag"]],
  ]),
];

/**
 * Rows of one group: id, keys, label, and what the table shows in place of the keys.
 *
 * @param {string} group
 * @param {[string, string[], string, string[]?][]} list
 * @returns {KeyRow[]}
 */
function rows(group, list) {
  return list.map(([id, keys, label, shown]) => ({ id, keys, shown, label, group }));
}

function alt(/** @type {string} */ keys) {
  return [...keys].map((key) => `Alt+${key}`);
}

function digits(/** @type {string} */ prefix) {
  return [..."123456789"].map((digit) => prefix + digit);
}

function arrows(/** @type {string[]} */ prefixes) {
  return prefixes.flatMap((prefix) =>
    ["ArrowLeft", "ArrowUp", "ArrowRight", "ArrowDown"].map((name) => prefix + name),
  );
}

/** The name of a keyboard event's key, as in the table. */
function keyName(/** @type {KeyboardEvent} */ event) {
  let name = event.key === " " ? "Space" : event.key;
  // a Mac types other characters with Alt
  const plain = event.altKey && !/^[a-z0-9]$/i.test(name) && /^(?:Key|Digit)(.)$/.exec(event.code);
  if (plain) name = plain[1];
  const isLetter = /^\p{L}$/u.test(name);
  if (isLetter) name = name.toUpperCase();
  const shift = event.shiftKey && (isLetter || name.length > 1) ? "Shift+" : "";
  return `${event.ctrlKey || event.metaKey ? "Ctrl+" : ""}${event.altKey ? "Alt+" : ""}${shift}${name}`;
}

const TYPED = new Set(["text", "search", "email", "url", "password", "tel", "date", "time"]);

/** True if a key belongs to the focused field. */
function isForField(/** @type {KeyboardEvent} */ event, /** @type {string} */ name) {
  if (/^Alt\+[0-9A-Z]$/.test(name)) return false;
  // an element of this page or of the 3D view's, or a window
  const {
    tagName: tag,
    type = "",
    isContentEditable = false,
  } = /** @type {Partial<HTMLInputElement>} */ (event.composedPath()[0] ?? {});
  if (tag === "TEXTAREA" || isContentEditable || (tag === "INPUT" && TYPED.has(type))) return name !== "F6";
  // a number field needs digits and signs, but no letters
  if (tag === "INPUT" && (type === "number" || type === "range"))
    return !/^(Ctrl\+(Shift\+)?[GZY]|Space|[A-DF-Z]|F6)$/.test(name);
  if (tag === "SELECT") return name !== "F6" && !name.startsWith("Ctrl+");
  // on a focused control, Tab moves to the next one and Enter activates it
  if (tag === "BUTTON" || tag === "A" || tag === "INPUT" || tag === "SUMMARY")
    return /^(Shift\+)?Tab$/.test(name) || name === "Enter";
  return false;
}

export function createKeys() {
  /** @type {Map<string, KeyHandler[]>} */
  const handlers = new Map();
  /** @type {string | null} */
  let mode = null;

  function onKey(/** @type {KeyboardEvent} */ event) {
    if (event.defaultPrevented || document.querySelector("dialog[open], :popover-open")) return;
    const name = keyName(event);
    const digit = /^Digit([1-9])$/.exec(event.code)?.[1];
    const isPlain = digit && !event.ctrlKey && !event.altKey && !event.metaKey;
    // with Shift, a digit's key types another character, or on some keyboards the digit
    const shifted = isPlain && event.shiftKey ? findRow(`Shift+${digit}`) : undefined;
    const row = shifted ?? findRow(name) ?? (isPlain && !event.shiftKey ? findRow(digit) : undefined);
    const handler = row && handlers.get(row.id)?.at(-1);
    if (!handler || isForField(event, name)) return;
    // with Alt, a letter may be typed after all
    if (row.id !== "attribute") leaveField();
    const isHeld = event.repeat && !REPEATED.test(row.id);
    if (!isHeld && handler(digit && !row.keys.includes(name) ? digit : name) === false) return;
    event.preventDefault();
    event.stopImmediatePropagation();
  }

  function findRow(/** @type {string} */ name) {
    return KEYS.find(
      ({ id, keys, group }) =>
        keys.includes(name) && (group === EVERYWHERE || mode === "annotate") && handlers.get(id)?.length,
    );
  }

  return {
    table: KEYS,

    /** Which mode's rows are active. */
    setMode(/** @type {string | null} */ name) {
      mode = name;
    },

    /**
     * Registers handlers: {"class": (key) => ...}. One that returns false leaves the key to the browser.
     * The newest handler of an id is used. Returns a function that removes these handlers.
     */
    register(/** @type {Record<string, KeyHandler>} */ map) {
      const added = Object.entries(map);
      for (const [id, fn] of added) {
        if (!KEYS.some((row) => row.id === id)) throw new Error(`no row '${id}' in the key table`);
        handlers.set(id, [...(handlers.get(id) ?? []), fn]);
      }
      return () => {
        for (const [id, fn] of added) {
          const others = (handlers.get(id) ?? []).filter((other) => other !== fn);
          handlers.set(id, others);
        }
      };
    },

    /** Listens to the keys of a window: the page's own, or the 3D view's. */
    listen(/** @type {Window} */ target) {
      target.addEventListener("keydown", onKey, { capture: true });
    },
  };
}
