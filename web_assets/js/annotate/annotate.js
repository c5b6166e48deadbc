/**
 * Annotate: boxes are drawn, proposals are reviewed, and both are corrected. A drag on the image gives a dashed box, one
 * key takes it; where it is wrong, its edges are dragged on views along its axes, or its 2D boxes on the pseudo-views,
 * which teach the detectors. A queue provides the next proposal.
 *
 * This file assembles the parts. The desk (desk.js) holds the selection and saves, teach.js holds what is drawn on the
 * pseudo-views, the queue (queue.js) provides the next item, opening.js opens frames, commands.js holds what keys and
 * buttons do. The other parts draw, and pass on the operator's actions.
 */

import { createAttributes } from "../attributes.js";
import { createNextClass } from "../classes/picker.js";
import { button, h } from "../dom.js";
import { createFrameProblem } from "../frame_problem.js";
import { showHints } from "../messages.js";
import { addRecordings } from "../start/recordings.js";
import { createActions } from "./actions.js";
import { createAreas } from "./areas.js";
import { createCommands } from "./commands.js";
import { createDesk } from "./desk.js";
import { createFields } from "./fields.js";
import { createFollow } from "./follow.js";
import { createImagePanel } from "./image_panel.js";
import { createMap } from "./map.js";
import { createOpening, trackIn } from "./opening.js";
import { createOrthoViews } from "./ortho_views.js";
import { createPreload } from "./preload.js";
import { createQueue } from "./queue.js";
import { createScene } from "./scene.js";
import { createSheet } from "./sheet.js";
import { createBoxList, createQueueList } from "./side_lists.js";
import { createTeach } from "./teach.js";
import { createTracks } from "./tracks.js";

/** A picture with a greater ratio of width to height gets a wider place. */
const WIDE_ASPECT = 1.9;

export function mount(/** @type {HTMLElement} */ root, /** @type {ModeApp} */ app, /** @type {AbortSignal} */ until) {
  root.classList.add("fixed");
  if (app.state.project.frames === 0) {
    root.append(emptyProject(app));
    return;
  }
  const parts = layout();
  root.append(parts.root);
  showHints(parts.problem, parts.hint, parts.saving);
  const desk = createDesk(app);
  const queue = createQueue(app, showQueue);
  const opening = createOpening(app, {
    desk,
    queue,
    onLoading() {
      showBusy();
      if (opening.loading) actions.show();
      else showAll();
    },
    onProblem(error, frame) {
      scene.fail(frame);
      if (error === null) problem.hide();
      else problem.show(error);
    },
  });
  const preload = createPreload(app, desk, queue, opening);
  const picker = createNextClass(parts.classes, app);
  const areas = createAreas(parts.root);
  const core = { app, parts, until, desk, queue, opening, preload, picker, areas, showDrawn, showBest };
  const at = Object.assign(/** @type {Annotate} */ ({}), core);
  at.sheet = createSheet(at);
  at.tracks = createTracks(at);
  at.follow = createFollow(at);
  at.image = createImagePanel(at);
  at.scene = createScene(at);
  at.ortho = createOrthoViews(at);
  at.teach = createTeach(at);
  const fields = createFields(at);
  at.attributes = createAttributes(fields.attributes, app, {
    shown: () => desk.shown,
    set: desk.setValues,
    setClass: (label) => desk.shown !== null && void desk.edit({ label }),
  });
  at.commands = createCommands(at);
  at.actions = createActions(at);
  at.map = createMap(at);
  const { image, scene, ortho, teach, attributes, tracks, actions, map } = at;
  const queueList = createQueueList(at);
  const boxList = createBoxList(at);
  const problem = createFrameProblem(image.body, {
    onRetry: () => opening.broken !== null && void opening.open(opening.broken, null),
    onStep: opening.step,
  });
  /** The labels before an undo. @type {{ frame: number, labels: Map<string, string> } | null} */
  let seen = null;
  let drawing = 0;

  // -- showing

  /** Its rows come after the pictures, and once for all that changes until then: they take longer than all else. */
  function showQueue() {
    actions.show();
    cancelAnimationFrame(drawing);
    drawing = requestAnimationFrame(() => setTimeout(() => queueList.show(desk.uid)));
  }

  function showBusy() {
    const isSaving = desk.isSaving || teach.isSaving;
    parts.root.toggleAttribute("data-saving", isSaving);
    parts.saving.textContent = isSaving ? "saving …" : opening.loading ? "opening …" : "";
  }

  /** The next frame is shown once, when its box is selected; what comes late, after the mode was left, is not. */
  const isBetween = () => opening.loading || until.aborted;

  /** The object that is drawn has changed. */
  function showDrawn() {
    showBusy();
    if (isBetween()) return;
    image.show();
    boxList.show();
    fields.show();
    actions.show();
    scene.show();
  }

  /** Goes to the camera that sees a box of the moment best. */
  function showBest(/** @type {string} */ uid) {
    if (opening.opened !== null && desk.stored(uid)) void opening.go({ frame: opening.opened, uid });
  }

  function showAll() {
    if (isBetween()) return;
    const picture = app.state.frame?.image;
    parts.root.classList.toggle("wide", picture !== undefined && picture.width > WIDE_ASPECT * picture.height);
    showBox();
    picker.show();
    const track = desk.stored()?.track_id ?? null;
    if (track !== app.state.track) app.state.set({ track });
    showQueue();
    scene.show();
    void ortho.show();
  }

  /** What shows the selected box, except those parts that follow a drag in another way. */
  function showBox() {
    for (const part of [image, boxList, fields, attributes, tracks, map]) part.show();
  }

  const offDesk = desk.on((what) => {
    if (what === "saving") {
      showBusy();
    } else if (what === "draft") {
      showBox();
      ortho.follow();
      scene.preview();
      if (!desk.hasDraft) void ortho.show();
    } else {
      if (what === "selection") {
        queue.visit(desk.uid);
        if (desk.shown) picker.pick(desk.shown.label);
        teach.follow();
      }
      showAll();
    }
  });
  const onFrame = (/** @type {FrameState | null} */ frame) => {
    if (!frame) return;
    desk.settle();
    teach.settle();
    queue.settle(frame);
    selectWhatWasUndone(frame);
  };
  const onProject = () => {
    queueList.fill();
    teach.show();
    showAll();
  };
  const onClasses = (/** @type {Messages["classes"]} */ { renamed }) => {
    desk.rename(renamed);
    teach.rename(renamed);
    catchUp();
  };
  app.state.on("frame", onFrame, until);
  app.state.on("project", onProject, until);
  app.events.on("classes", onClasses, until);
  for (const type of /** @type {const} */ (["frame", "still", "reconnected"])) app.events.on(type, catchUp, until);
  const offKeys = app.keys.register(at.commands.keys);
  until.addEventListener("abort", () => {
    offDesk();
    offKeys();
    queue.end();
    preload.stop();
    app.events.openFrame(null);
  });

  /** Others have saved something. */
  function catchUp() {
    queue.reloadSoon();
    void desk.refresh();
  }

  /** Selects the label that an undo or redo has changed. */
  function selectWhatWasUndone(/** @type {FrameState} */ frame) {
    if (!seen) return;
    const before = seen;
    seen = null;
    if (before.frame !== frame.frame.id) return;
    const changed = frame.labels.find((label) => before.labels.get(label.uid) !== fingerprint(label));
    if (changed) desk.select(changed.uid);
  }

  /** Whether a frame is of the open moment: its boxes are the same in all cameras, also those that are not stored. */
  const isOfMoment = (/** @type {number | null} */ frame) =>
    Object.values(app.state.frame?.frame.cameras ?? {}).includes(frame ?? -1);

  actions.show();
  void opening.begin();

  return {
    route(/** @type {Route} */ { frame, query }) {
      const [uid, track] = [query.get("uid") ?? (isOfMoment(frame) ? desk.uid : null), trackIn(query)];
      if (frame === null) void opening.begin();
      else if (frame !== opening.opened && frame !== opening.broken)
        void opening.open(frame, uid, track).then((isOpen) => {
          if (isOpen === false && opening.opened !== null) app.stay(opening.opened);
        });
      else if (uid) desk.select(uid);
      else if (track !== null) opening.pick(null, track);
    },
    unsaved(/** @type {number | null} */ to) {
      const all = [teach.unsaved, isOfMoment(to) ? null : desk.unsaved].filter((one) => one !== null);
      if (all.length === 0) return null;
      return {
        text: all.map(({ text }) => text).join(" "),
        retry: () => Promise.all(all.map(({ retry }) => retry())),
        discard() {
          for (const { discard } of all) discard();
        },
      };
    },
    async flush() {
      image.editor.flush();
      await teach.flush();
      await desk.flush();
      if (app.state.frame)
        seen = {
          frame: app.state.frame.frame.id,
          labels: new Map(desk.labels().map((label) => [label.uid, fingerprint(label)])),
        };
    },
  };
}

const fingerprint = (/** @type {PageLabel} */ { state, label, track_id, box }) =>
  JSON.stringify([state, label, track_id, box]);

// -- its panels

export function layout() {
  const part = (/** @type {string} */ name, /** @type {string} */ label) =>
    h("section", { class: `panel ${name}`, "aria-label": label });
  const status = (/** @type {string} */ name, /** @type {string} */ id) =>
    h("span", { class: name, role: "status", "data-testid": id });
  const parts = {
    queue: part("queue", "Queue"),
    boxes: part("of-frame", "Boxes of this frame"),
    classes: part("next-class", "Class of the next box"),
    image: part("image", "Camera image"),
    scene: part("scene", "3D view"),
    sceneHead: h("header"),
    map: part("scene", "Top view"),
    actions: h("div.actions", { role: "toolbar", "aria-label": "Actions" }),
    object: h("div.object"),
    ortho: h("div.orthos", { "data-testid": "orthos" }),
    fields: part("fields", "Selected box"),
    track: h("div.of-track"),
    // in the line of messages
    problem: h("span"),
    hint: status("ellipsis", "image-note"),
    saving: status("muted", "saving"),
  };
  parts.scene.append(parts.sceneHead);
  parts.object.append(parts.ortho);
  const root = h(
    "div.annotate",
    h("h1.visually-hidden", "Annotate"),
    h("div.lists", parts.queue, parts.boxes, parts.classes),
    parts.image,
    parts.scene,
    parts.map,
    h("div.bar", parts.actions),
    parts.object,
    h("div.numbers", parts.fields, parts.track),
  );
  return { ...parts, root };
}

/** Shown in place of the panels if the project has no frame. */
export function emptyProject(/** @type {ModeApp} */ app) {
  const { name } = app.state.project;
  const add = async () => {
    await addRecordings(app, name);
    await app.refreshProject();
    app.go(location.hash);
  };
  return h(
    "div.empty",
    { "data-testid": "no-frames" },
    h("h2", `${name} has no recording yet`),
    h(
      "p",
      "A recording is a folder or file of images and depth, of point clouds, or of both. Its files stay where they are.",
    ),
    button("Add recordings", add, { class: "primary" }),
  );
}
