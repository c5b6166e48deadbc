/**
/**
 * The track of an object: steps to its next and previous box, its box copied to the next frame, and what is done to the
 * whole track, or to the span of it that is selected on the timeline. The server does the work (workflows/tracks).
 */

import { openDialog } from "../dialogs.js";
import { trackColor } from "../colors.js";
import { button, count, h } from "../dom.js";
import { messageOf } from "../errors.js";
import { checkbox, field, select } from "../forms.js";
import { makeHash } from "../router.js";
import { currentFrame } from "../frame_state.js";

/** A copy with fewer points inside stands on nothing. */
const LEAST_POINTS = 5;

/** What to say about boxes that were copied from the previous frame, and how. @returns {[string, "good" | "warn"]} */
export function copiedText(/** @type {PageLabel[]} */ copies) {
  const empty = copies.filter(({ points }) => points < LEAST_POINTS);
  const what = `${count(copies.length, "box", "boxes")} copied from the previous frame, to be reviewed.`;
  if (empty.length === 0) return [what, "good"];
  const which = copies.length === 1 ? "It holds" : `${count(empty.length, "copy holds", "copies hold")}`;
  const few = empty.some(({ points }) => points > 0) ? "hardly any" : "no";
  return [`${what} ${which} ${few} points here: move or delete ${empty.length === 1 ? "it" : "them"}.`, "warn"];
}

/**
 * What is done to a track: the text of the button, its key, and the operation, by default of the whole track.
 *
 * @type {Record<string, { text: string, key: string, help: string,
 *     of: (label: PageLabel, frame: number, timeline: Timeline | null) => Record<string, unknown> }>}
 */
export const OPERATIONS = {
  split: {
    text: "Split here",
    key: "E",
    help: "The boxes from this frame on get a new number.",
    of: (_, frame) => ({ do: "number", from: frame }),
  },
  merge: {
    text: "Merge…",
    key: "⇧M",
    help: "Where both tracks have a box in a frame, the reviewed one stays, or else that of this track.",
    of: () => ({ do: "merge" }),
  },
  class: { text: "Class…", key: "⇧1", help: "All boxes of the track get this class.", of: () => ({ do: "class" }) },
  size: {
    text: "One size",
    key: "Z",
    help: "All boxes get the size that fits them and their points: the reviewed ones, if there are any. Each keeps its rotation, its bottom, and the sides that face the camera.",
    of: () => ({ do: "size" }),
  },
  values: {
    text: "Values",
    key: "",
    help: "All boxes of the track get the attributes of this one.",
    of: ({ attributes }) => ({ do: "values", values: attributes }),
  },
  fill: {
    text: "Fill gap",
    key: "I",
    help: "Boxes are proposed between this one and those before and after it.",
    of: (label, frame, timeline) => ({ do: "fill", ...besides(timeline, label.track_id, frame) }),
  },
  still: {
    text: "Stands still",
    key: "A",
    help: "This box is that of all frames which see the object, by their points. Proposals, and reviewed boxes that agree, go.",
    of: (_, frame) => ({ do: "still", frame }),
  },
  delete: {
    text: "Delete on",
    key: "⇧Del",
    help: "The boxes of this frame and of all later ones are deleted.",
    of: (_, frame) => ({ do: "delete", from: frame }),
  },
};

/** In place of `OPERATIONS.still` for what stands still already. @type {typeof OPERATIONS[string]} */
const MOVING = {
  text: "Moves",
  key: "A",
  help: "The box stays in this frame. In the others that saw the object, it is a proposal.",
  of: (_, frame) => ({ do: "moving", frame }),
};

/**
 * From the track's box before a frame to the one after it, as the timeline has them.
 *
 * @returns {{ from: number, to: number }}
 */
function besides(
  /** @type {Timeline | null} */ timeline,
  /** @type {number | null} */ track,
  /** @type {number} */ frame,
) {
  const spans = timeline?.lanes.find(({ track_id }) => track_id === track)?.spans ?? [];
  const place = timeline?.frames.indexOf(frame) ?? -1;
  const before = spans.flatMap(([first, last]) => (first < place ? [Math.min(last, place - 1)] : [])).at(-1);
  const after = spans.flatMap(([first, last]) => (last > place ? [Math.max(first, place + 1)] : []))[0];
  return { from: timeline?.frames[before ?? place] ?? frame, to: timeline?.frames[after ?? place] ?? frame };
}

export function createTracks(/** @type {Annotate} */ at) {
  const { app, desk, opening } = at;
  const title = h("span.grow.ellipsis");
  const all = button(["Sheet", h("kbd", "S")], () => at.commands.keys.sheet(""), {
    title: "All boxes of this track as small pictures, to be accepted together (S)",
    "data-testid": "act-sheet",
  });
  const acts = Object.entries(OPERATIONS).map(([id, { text, key, help }]) =>
    button([text, key ? h("kbd", key) : null], () => void operate(id), {
      title: help,
      "data-testid": `track-${id}`,
    }),
  );
  const actOf = (/** @type {string} */ id) => acts[Object.keys(OPERATIONS).indexOf(id)];
  const only = h("input", { type: "checkbox", "data-testid": "track-here" });
  only.addEventListener("change", () => desk.setHere(only.checked));
  const here = h(
    "label",
    { title: "What is changed or deleted now concerns this frame only." },
    only,
    " Only this frame",
  );
  const body = h(
    "div.track",
    { hidden: true },
    h("div.row", title, here, all),
    h("div.row", { role: "toolbar", "aria-label": "This track" }, acts),
  );
  at.parts.track.append(body);

  const recording = () => currentFrame(app).frame.recording;
  const path = (/** @type {number} */ id) => app.path("recordings", recording(), "tracks", id);

  function show() {
    const { shown: label } = desk;
    const id = desk.stored()?.track_id ?? null;
    body.hidden = !label || id === null;
    if (!label || id === null) return;
    title.textContent = `Track ${id}`;
    // the colours of tracks are too light for text
    const dot = h("span.dot");
    dot.style.background = trackColor(id);
    title.prepend(dot);
    actOf("values").hidden = Object.keys(label.attributes).length === 0;
    actOf("still").setAttribute("aria-pressed", String(label.still));
    here.hidden = !label.still;
    for (const id of ["split", "merge", "fill", "delete"]) actOf(id).hidden = label.still;
    only.checked = desk.isHere;
  }

  /** Goes to the next (by = 1) or previous (by = -1) frame with the same object. */
  function step(/** @type {number} */ by) {
    const label = desk.stored();
    if (!label) return;
    if (label.track_id === null)
      return app.toast("This box has no track yet. Type a number in its field Track.", "warn");
    const { id } = currentFrame(app).frame;
    const { from, to } = besides(app.state.timeline, label.track_id, id);
    const target = by > 0 ? to : from;
    if (target === id)
      return app.toast(by > 0 ? "No later frame has this object." : "No earlier frame has this object.");
    app.go(makeHash(app.state.project.name, "annotate", target, { track: String(label.track_id) }));
  }

  /** Copies the selected box to the next frame, and goes there. */
  async function copyToNext() {
    const label = desk.stored();
    if (!label || label.isNew) return;
    await desk.flush();
    const done = await desk.change({ path: ["copy-next"], body: () => ({ uid: label.uid }), stateOf: () => null });
    await opening.go(done);
    const copies = desk.labels().filter(({ uid }) => uid === done.uid);
    app.toast(...copiedText(copies));
  }

  /**
   * Asks for what an operation needs, tells what it does, and does it.
   *
   * @param {string} id
   * @param {string} [digit] the key of a class.
   */
  async function operate(id, digit = "") {
    const label = desk.stored();
    if (!label || label.isNew) return;
    const { track_id: track } = label;
    if (track === null) return app.toast("This box has no track. Enter a track id, or follow it.", "warn");
    await desk.flush();
    const { id: frame } = currentFrame(app).frame;
    const { text, help, of } = id === "still" && label.still ? MOVING : OPERATIONS[id];
    const { span } = app.state;
    const selected = span?.trackId === track ? { from: span.from, to: span.to } : {};
    const field = fieldOf(id, label, digit);
    const body = () => ({
      operation: { ...of(label, frame, app.state.timeline), ...selected, ...field?.value() },
      at: frame,
    });
    const note = h("p", { role: "status", "data-testid": "track-count" }, "");
    /** @type {Api.OperationOut | null} */
    let told = null;
    let asked = 0;

    async function tell() {
      asked += 1;
      const own = asked;
      told = null;
      try {
        const answer = await app.api.post(path(track ?? 0), body());
        if (own === asked) {
          [told, note.textContent] = [answer, `This ${answer.words}.`];
          field?.take?.(answer.count);
        }
      } catch (error) {
        if (own === asked) note.textContent = messageOf(error);
      }
    }

    let telling = tell();
    await telling;
    if (!field && told === null) return app.toast(note.textContent, "warn");
    field?.root.addEventListener("input", () => {
      telling = tell();
    });
    const done = await openDialog({
      title: `Track ${track}: ${text.replace("…", "")}`,
      testid: "track-operation",
      content: [h("p.muted", help), ...(field ? [field.root] : []), note],
      actions: [{ label: text.replace("…", ""), value: "yes", kind: id === "delete" ? "danger" : "primary" }],
      async submit() {
        // nothing happens that was not told before
        const read = note.textContent;
        await telling;
        if (told === null) throw new Error(note.textContent);
        if (note.textContent !== read) throw new Error("Read above what this does now, then confirm it.");
        const sent = { ...body(), operation: told.operation, told: told.count };
        app.effort.action();
        return desk.enqueue(() => app.api.change(path(track), sent));
      },
    });
    if (!done) return;
    app.toast(`Track ${track}: ${done.words}.`, "good");
    // this frame and others are read again, also before the message of the change has come
    app.frames.miss();
    await app.frames.refresh();
    // the box of one that stands still is another one
    if (!desk.stored()) desk.select(desk.labels().find(({ track_id }) => track_id === track)?.uid ?? null);
    // boxes of other frames may have new uids
    await at.queue.load();
    at.sheet.again();
  }

  /**
   * What an operation needs to know beside the box: its field, what that gives, and how it shows what the server
   * proposes.
   *
   * @returns {{ root: HTMLElement, value: () => object, take?: (count: Api.Count) => void } | null}
   */
  function fieldOf(/** @type {string} */ id, /** @type {PageLabel} */ label, /** @type {string} */ digit) {
    if (id === "merge") {
      const input = h("input", { type: "number", min: 0, step: 1, autofocus: true, "data-testid": "track-other" });
      return {
        root: field("Number of the other track", input),
        // without a number, the server names the likeliest one
        value: () => (input.value ? { number: input.valueAsNumber } : {}),
        take({ number }) {
          if (input.value) return;
          input.value = String(number);
          input.select();
        },
      };
    }
    if (id === "class") {
      const names = app.state.project.classes.map((name) => [name]);
      const chosen = app.state.project.classes[Number(digit) - 1] ?? label.label;
      const name = select(names, { "data-testid": "track-class-name" }, chosen);
      return { root: field("Class", name), value: () => ({ label: name.value }) };
    }
    if (id !== "fill") return null;
    const box = checkbox("track-refit");
    const root = h("label", box, " Fit each box to the points of its frame");
    return { root, value: () => ({ refit: box.checked }) };
  }

  return { show, step, copyToNext, operate };
}
