/**
 * In the top bar: the recording, the frame and the camera that are open, each to be changed there; and the other
 * operators who have the frame open.
 */

import { button, count, glyph, h, iconButton, patch } from "./dom.js";
import { onEnter } from "./forms.js";
import { makeHash } from "./router.js";
import { placeNow } from "./timeline/reading.js";

export const WITH_FRAME = new Set(["annotate", "alignment"]);

export function createWhere(/** @type {App} */ app) {
  const { state } = app;
  /** The frame that was open last, by project and recording. @type {Map<string, number>} */
  const visited = new Map();
  /** The number of the frame to go to, counted from 1. @type {number | null} */
  let asked = null;
  const recordings = createChooser(app, { name: "recordings", text: "Recordings", read: readRecordings });
  const cameras = createChooser(app, { name: "cameras", text: "Cameras of this moment", read: readCameras });
  const name = h("span.ellipsis", { "data-testid": "recording-name" });
  const camera = h("span.ellipsis", { "data-testid": "camera-name" });
  const nth = h("span.muted.number");
  recordings.button.append(name, glyph("down"));
  cameras.button.append(camera, nth, h("kbd", "K"));
  const position = button([], () => askFrame(), {
    class: "quiet number position",
    "data-testid": "frame-position",
  });
  const field = h("input.number.position", {
    type: "number",
    min: 1,
    step: 1,
    hidden: true,
    "aria-label": "Go to frame",
    "data-testid": "frame-field",
    onkeydown: (event) => {
      if (event.key === "Enter" && field.value) {
        asked = Number(field.value);
        goAsked();
      }
      if (event.key === "Enter" || event.key === "Escape") field.blur();
      if (event.key === "Escape") event.stopPropagation();
    },
    onblur: () => {
      field.hidden = true;
      position.hidden = false;
    },
  });
  const step = (/** @type {Direction} */ which) => () => {
    const target = state.frame?.frame[which] ?? null;
    if (target !== null) go(target);
  };
  const previous = iconButton("previous", "Previous frame in time", step("previous"));
  const next = iconButton("next", "Next frame in time", step("next"));
  const others = h("span.presence.ellipsis", { "data-testid": "presence" });
  const finalised = "Finalised: automatic passes do not change this frame";
  const lock = h("span.muted", { title: finalised }, glyph("lock"));
  const root = h(
    "div.where",
    h("span.divider"),
    recordings.button,
    previous,
    position,
    field,
    next,
    cameras.button,
    lock,
    others,
    recordings.list,
    cameras.list,
  );

  function go(/** @type {number} */ frame) {
    const { project, mode } = state.route;
    if (project !== null) app.go(makeHash(project, mode, frame));
  }

  function askFrame() {
    field.value = String(placeNow(state) + 1 || "");
    field.hidden = false;
    position.hidden = true;
    field.select();
    field.focus();
  }

  /** Goes to the frame with the number that was asked for, or the nearest one, once the frames are known. */
  function goAsked() {
    if (asked === null || state.timeline?.recording !== state.frame?.frame.recording || !state.timeline) return;
    const ids = state.timeline.frames;
    const place = Math.min(Math.max(Math.round(asked), 1), ids.length) - 1;
    asked = null;
    if (place !== placeNow(state)) go(ids[place]);
  }

  /** The cameras of the open frame's moment, in order. */
  function camerasNow() {
    const ids = state.frame?.frame.cameras ?? {};
    return (state.project?.recordings ?? []).flatMap((one) =>
      one.id in ids ? [{ ...one, frame: ids[one.id], isCurrent: one.id === state.frame?.frame.recording }] : [],
    );
  }

  function stepCamera(/** @type {number} */ by) {
    const all = camerasNow();
    const at = all.findIndex(({ isCurrent }) => isCurrent);
    if (all.length > 1) go(all[(at + by + all.length) % all.length].frame);
  }

  async function readCameras() {
    return camerasNow().map((one) => ({ ...one, name: cameraOf(one.name), note: "" }));
  }

  /** A row for each rig, whose cameras are in the other list: that of the camera that is open, if it has the same. */
  async function readRecordings() {
    const all = await app.api.get(app.path("recordings"));
    const kept = all.filter(({ removed_by }) => removed_by === null);
    const now = state.frame?.frame;
    return [...new Set(kept.map(({ rig_id }) => rig_id))].map((id) => {
      const rig = kept.filter(({ rig_id }) => rig_id === id);
      const one = rig.find((each) => cameraOf(each.name) === cameraOf(now?.recording_name ?? "")) ?? rig[0];
      const sum = (/** @type {"reviewed" | "proposed"} */ key) => rig.reduce((total, each) => total + each[key], 0);
      const [reviewed, boxes] = [sum("reviewed"), sum("reviewed") + sum("proposed")];
      const parts = [
        count(one.frames, "frame"),
        rig.length > 1 && count(rig.length, "camera"),
        one.missing ? "not found" : boxes > 0 ? `${reviewed} of ${count(boxes, "box", "boxes")} reviewed` : "no boxes",
      ];
      return {
        name: rig.length > 1 ? rigOf(one.name) : one.name,
        frame: visited.get(app.path(one.id)) ?? one.first,
        isCurrent: rig.some((each) => each.id === now?.recording),
        note: parts.filter(Boolean).join(" · "),
        done: boxes > 0 ? reviewed / boxes : null,
      };
    });
  }

  function show() {
    const { route, frame, timeline, presence, operator } = state;
    root.hidden = frame === null || !WITH_FRAME.has(route.mode);
    if (frame === null || root.hidden) return;
    const { recording, recording_name, key, index, finalised, id } = frame.frame;
    visited.set(app.path(recording), id);
    const all = camerasNow();
    const at = all.findIndex(({ isCurrent }) => isCurrent);
    name.textContent = all.length > 1 ? rigOf(recording_name) : recording_name;
    recordings.button.title = `${recording_name}: another recording`;
    position.title = `${key}: go to another frame (Ctrl+G)`;
    cameras.button.hidden = all.length < 2;
    cameras.button.title = `${recording_name}: another camera of this moment (K)`;
    camera.textContent = cameraOf(recording_name);
    nth.textContent = `${at + 1} of ${all.length}`;
    const place = placeNow(state);
    const frames = state.project?.recordings.find((one) => one.id === recording)?.frames;
    const total = place < 0 ? frames : timeline?.frames.length;
    position.textContent = `${(place < 0 ? (index ?? 0) : place) + 1}${total ? ` / ${total}` : ""}`;
    previous.disabled = frame.frame.previous === null;
    next.disabled = frame.frame.next === null;
    lock.hidden = !finalised;
    const names = (presence[id] ?? frame.open_by).filter((other) => other !== operator);
    others.textContent = names.length ? `also opened by ${names.join(", ")}` : "";
    others.title = others.textContent;
  }

  for (const part of /** @type {const} */ (["route", "frame", "project", "presence", "timeline"]))
    state.on(part, show);
  state.on("timeline", goAsked);
  app.keys.register({
    "go-to-frame": askFrame,
    "previous-camera": () => stepCamera(-1),
  });
  show();
  return root;
}

/** A camera's recording is named RIG@CAMERA. */
const rigOf = (/** @type {string} */ name) => name.split("@")[0];
const cameraOf = (/** @type {string} */ name) => name.split("@")[1] ?? name;

/**
 * A button, and the list that it opens: with a search if it is long.
 *
 * @param {App} app
 * @param {{ name: string, text: string, read: () => Promise<Choice[]> }} options
 */
function createChooser(app, { name, text, read }) {
  const rows = h("ul", { "data-testid": name });
  const search = h("input", {
    type: "search",
    placeholder: "Search",
    "aria-label": `Search ${text.toLowerCase()}`,
    autofocus: true,
    oninput: () => fill(),
    // the button that gets the focus back is not pressed
    onkeydown: onEnter(() => rows.querySelector("button")?.click()),
  });
  const list = h("div.chooser-list", { popover: "auto", role: "dialog", "aria-label": text }, search, rows);
  const opener = button([], () => list.togglePopover(), {
    class: "quiet chooser",
    "aria-haspopup": "dialog",
    "data-testid": `choose-${name}`,
  });
  /** @type {Choice[]} */
  let choices = [];
  list.addEventListener("toggle", (event) => {
    if (/** @type {ToggleEvent} */ (event).newState === "open") void open();
  });

  async function open() {
    list.style.left = `${opener.getBoundingClientRect().left}px`;
    search.value = "";
    choices = await read();
    fill();
    rows.querySelector("[aria-current]")?.scrollIntoView({ block: "nearest" });
  }

  function fill() {
    const wanted = search.value.trim().toLowerCase();
    patch(rows, choices.filter((one) => one.name.toLowerCase().includes(wanted)).map(row));
  }

  function row(/** @type {Choice} */ { name, frame, isCurrent, note, done = null }) {
    const { project, mode } = app.state.route;
    const isThere = frame !== null && project !== null;
    const src = isThere && `${app.path("frames", frame)}/image.jpg?width=96`;
    const content = [
      src ? h("img", { src, alt: "", loading: "lazy" }) : h("span.no-picture"),
      h("span.title", name),
      h("span.note.muted", note, done === null ? null : h("progress", { max: 1, value: done })),
    ];
    const go = () => {
      list.hidePopover();
      if (isThere) app.go(makeHash(project, mode, frame));
    };
    const more = { class: "quiet", "aria-current": isCurrent ? "true" : null, disabled: !isThere };
    return h("li", { "data-key": name }, button(content, go, more));
  }

  return { button: opener, list };
}
