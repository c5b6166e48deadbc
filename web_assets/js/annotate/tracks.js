/**
/**
 * The track of an object: steps to its next and previous box, its box copied to the next frame, and what is done to the
 * whole track, or to the span of it that is selected on the timeline. The server does the work (workflows/tracks).
 */

import { openDialog } from "../dialogs.js";
import { trackColor } from "../colors.js";
import { button, count, h } from "../dom.js";
import { messageOf } from "../errors.js";
import { currentFrame } from "../frame_state.js";

/** A copy with fewer points inside stands on nothing. */
const LEAST_POINTS = 5;

/**
 * What to say about boxes that were copied from the previous frame, and how.
 *
 * @returns {[string, "good" | "warn"]}
 */
export function copiedText(/** @type {PageLabel[]} */ copies) {
  const empty = copies.filter(({ points }) => points < LEAST_POINTS);
  const what = `${count(copies.length, "box", "boxes")} copied from the previous frame, to be reviewed.`;
  if (empty.length === 0) return [what, "good"];
  const which = copies.length === 1 ? "It holds" : `${count(empty.length, "copy holds", "copies hold")}`;
  const few = empty.some(({ points }) => points > 0) ? "hardly any" : "no";
  return [`${what} ${which} ${few} points here: move or delete ${empty.length === 1 ? "it" : "them"}.`, "warn"];
}

/**
 * What is done to a track: the text of the button, its key, what the dialog says above the count, and the operation.
 *
 * @type {Record<string, { text: string, key: string, title: (track: number) => string, help: string,
 *     span: (timeline: Timeline | null, track: number, frame: number) => FrameSpan,
 *     operation: (label: PageLabel) => Record<string, unknown> }>}
 */
export const OPERATIONS = {
  split: {
    text: "Split here",
    key: "E",
    title: (track) => `Split track ${track} here`,
    help: "The boxes from this frame on get a new number.",
    span: (_timeline, _track, frame) => ({ from: frame, to: null }),
    operation: () => ({ do: "number", number: null }),
  },
  merge: {
    text: "Merge…",
    key: "⇧M",
    title: (track) => `Merge track ${track} with another one`,
    help: "Where both have a box in a frame, the reviewed one stays, or else that of this track.",
    span: () => WHOLE,
    operation: () => ({ do: "number" }),
  },
  class: {
    text: "Class…",
    key: "⇧1",
    title: (track) => `Class of track ${track}`,
    help: "All boxes of the track get this class.",
    span: () => WHOLE,
    operation: () => ({ do: "class" }),
  },
  size: {
    text: "One size",
    key: "Z",
    title: (track) => `One size for track ${track}`,
    help: "All boxes get the size of this one. Each keeps its rotation, its bottom, and the sides that face the camera.",
    span: () => WHOLE,
    operation: ({ box }) => ({ do: "size", size_m: box.size }),
  },
  values: {
    text: "Values",
    key: "",
    title: (track) => `Values of track ${track}`,
    help: "All boxes of the track get the attributes of this one.",
    span: () => WHOLE,
    operation: ({ attributes }) => ({ do: "values", values: attributes }),
  },
  fill: {
    text: "Fill gap",
    key: "I",
    title: (track) => `Fill the gaps of track ${track} beside this box`,
    help: "Boxes are proposed between this box and the ones before and after it.",
    span: besides,
    operation: () => ({ do: "fill" }),
  },
  delete: {
    text: "Delete on",
    key: "⇧Del",
    title: (track) => `Delete track ${track} from here on`,
    help: "The boxes of this frame and of all later ones are deleted.",
    span: (_timeline, _track, frame) => ({ from: frame, to: null }),
    operation: () => ({ do: "delete" }),
  },
};

/** @type {FrameSpan} */
const WHOLE = { from: null, to: null };

/**
 * From the track's box before a frame to the one after it, as the timeline has them.
 *
 * @returns {FrameSpan}
 */
function besides(/** @type {Timeline | null} */ timeline, /** @type {number} */ track, /** @type {number} */ frame) {
  const spans = timeline?.lanes.find(({ track_id }) => track_id === track)?.spans ?? [];
  const place = timeline?.frames.indexOf(frame) ?? -1;
  const before = spans.flatMap(([first, last]) => (first < place ? [Math.min(last, place - 1)] : [])).at(-1);
  const after = spans.flatMap(([first, last]) => (last > place ? [Math.max(first, place + 1)] : []))[0];
  return { from: timeline?.frames[before ?? place] ?? frame, to: timeline?.frames[after ?? place] ?? frame };
}

/**
 * `open` shows a box in its frame, `sheet` the contact sheet. `onChanged` is called when boxes of other frames have
 * changed.
 */
export function createTracks(
  /** @type {HTMLElement} */ host,
  /** @type {ModeApp} */ app,
  /** @type {Desk} */ desk,
  /** @type {{ open: (target: Target) => unknown, sheet: () => unknown, onChanged: () => unknown }} */ {
    open,
    sheet,
    onChanged,
  },
) {
  const title = h("span", { class: "grow ellipsis" });
  const all = button(["Sheet", h("kbd", {}, "S")], () => sheet(), {
    title: "All boxes of this track as small pictures, to be accepted together (S)",
    "data-testid": "act-sheet",
  });
  const alike = button(["Alike", h("kbd", {}, "A")], () => void carry(), {
    title: "Correct the boxes after this one, the track's last reviewed one, alike (A)",
    "data-testid": "act-carry",
  });
  const acts = Object.entries(OPERATIONS).map(([id, { text, key, help }]) =>
    button([text, key ? h("kbd", {}, key) : null], () => void operate(id), {
      title: help,
      "data-testid": `track-${id}`,
    }),
  );
  const values = acts[Object.keys(OPERATIONS).indexOf("values")];
  const body = h(
    "div",
    { class: "track", hidden: true },
    h("div", { class: "row" }, title, all, alike),
    h("div", { class: "row", role: "toolbar", "aria-label": "This track" }, acts),
  );
  host.append(body);

  const recording = () => currentFrame(app).frame.recording;
  const path = (/** @type {number} */ id) => app.path("recordings", recording(), "tracks", id);

  function show() {
    const { shown: label } = desk;
    const id = desk.stored()?.track_id ?? null;
    body.hidden = !label || id === null;
    if (!label || id === null) return;
    title.textContent = `Track ${id}`;
    // the colours of tracks are too light for text
    const dot = h("span", { class: "dot" });
    dot.style.background = trackColor(id);
    title.prepend(dot);
    alike.disabled = desk.formerBox(label.uid) === null;
    values.hidden = Object.keys(label.attributes).length === 0;
  }

  /** Goes to the next (by = 1) or previous (by = -1) frame with the same object. */
  async function step(/** @type {number} */ by) {
    const label = desk.stored();
    if (!label) return;
    if (label.track_id === null)
      return app.toast("This box has no track yet. Type a number in its field Track.", "warn");
    try {
      const index = currentFrame(app).frame.index ?? 0;
      /** @type {Api.TrackBox[]} */
      const boxes = await app.api.get(path(label.track_id));
      const others = boxes.filter(
        (box) => box.index !== null && box.state !== "rejected" && (by > 0 ? box.index > index : box.index < index),
      );
      const next = by > 0 ? others[0] : others[others.length - 1];
      if (next) await open({ frame: next.frame, uid: next.uid });
      else app.toast(by > 0 ? "No later frame has this object." : "No earlier frame has this object.");
    } catch (error) {
      app.toast(error);
    }
  }

  /** Copies the selected box to the next frame, and goes there. */
  async function copyToNext() {
    const label = desk.stored();
    if (!label || label.isNew) return;
    await desk.flush();
    try {
      /** @type {Api.CopyNextOut} */
      const done = await desk.change("copy-next", () => ({ uid: label.uid }));
      await open(done);
      const copies = desk.labels().filter(({ uid }) => uid === done.uid);
      app.toast(...copiedText(copies));
    } catch (error) {
      app.toast(error);
    }
  }

  /**
   * Asks for what an operation needs, says what it does, and does it.
   *
   * @param {string} id
   * @param {string} [digit] the class's key.
   */
  async function operate(id, digit = "") {
    const label = desk.stored();
    if (!label || label.isNew) return;
    if (label.track_id === null) return app.toast("This box has no track. Enter a track id, or follow it.", "warn");
    await desk.flush();
    const { title: titleOf, help, text, ...of } = OPERATIONS[id];
    const [track, { id: frame }] = [label.track_id, currentFrame(app).frame];
    const selected = app.state.span?.trackId === track ? app.state.span : null;
    const { from, to } = selected ?? of.span(app.state.timeline, track, frame);
    const fixed = { ...of.operation(label), from, to };
    const field = fieldOf(id, label, app.state.project.classes, digit);
    const note = h("p", { role: "status", "data-testid": "track-count" });
    const body = () => ({ operation: { ...fixed, ...field?.value() }, at: frame });
    /** @type {Api.OperationOut | null} */
    let told = null;
    let asked = 0;

    async function tell() {
      asked += 1;
      const own = asked;
      told = null;
      try {
        /** @type {Api.OperationOut} */
        const answer = await app.api.post(path(track), body());
        if (own !== asked) return;
        told = answer;
        note.textContent = `This ${answer.words}.`;
      } catch (error) {
        if (own === asked) note.textContent = messageOf(error);
      }
    }

    if (!field?.isEmpty) await tell();
    if (!field && told === null) return app.toast(note.textContent, "warn");
    field?.root.addEventListener("input", () => void tell());
    const done = await openDialog({
      title: titleOf(track),
      testid: "track-operation",
      content: [h("p", { class: "muted" }, help), ...(field ? [field.root] : []), note],
      actions: [{ label: text.replace("…", ""), value: "yes", kind: id === "delete" ? "danger" : "primary" }],
      async submit() {
        // nothing happens that was not told before
        if (told === null) throw new Error(note.textContent || "Say with which track.");
        const { count: expected } = told;
        return desk.enqueue(() => app.api.change(path(track), { ...body(), told: expected }));
      },
    });
    if (!done) return;
    app.effort.action();
    app.toast(`Track ${track}: ${done.words}.`, "good");
    await app.frames.refresh();
    await onChanged();
  }

  /** Corrects the later proposals of the track like the selected box. */
  async function carry() {
    const label = desk.stored();
    if (!label || label.isNew) return;
    await desk.flush();
    const was = desk.formerBox(label.uid);
    if (was === null) return app.toast("Correct this box first; then A corrects the later ones alike.", "warn");
    try {
      /** @type {Api.CarryOut} */
      const { changed } = await desk.change("carry", () => ({ uid: label.uid, was }));
      app.toast(`${count(changed, "later box", "later boxes")} corrected alike.`, "good");
      await onChanged();
    } catch (error) {
      app.toast(error);
    }
  }

  return { show, step, copyToNext, carry, operate };
}

/**
 * The field of an operation, what it gives, and whether it is empty at first.
 *
 * @param {string} id
 * @param {PageLabel} label
 * @param {string[]} classes
 * @param {string} digit
 */
function fieldOf(id, label, classes, digit) {
  if (id === "merge") {
    const input = h("input", { type: "number", min: 0, step: 1, autofocus: true, "data-testid": "track-other" });
    const root = h("label", { class: "number-field" }, h("span", {}, "Number of the other track"), input);
    return { root, isEmpty: true, value: () => ({ number: input.valueAsNumber }) };
  }
  if (id === "class") {
    const options = classes.map((name) => h("option", { value: name }, name));
    const select = h("select", { "aria-label": "Class", "data-testid": "track-class-name" }, options);
    select.value = classes[Number(digit) - 1] ?? classes.find((name) => name !== label.label) ?? label.label;
    return {
      root: h("label", { class: "number-field" }, h("span", {}, "Class"), select),
      value: () => ({ label: select.value }),
    };
  }
  if (id !== "fill") return null;
  const box = h("input", { type: "checkbox", "data-testid": "track-refit" });
  return {
    root: h("label", {}, box, " Fit each box to the points of its frame"),
    value: () => ({ refit: box.checked }),
  };
}
