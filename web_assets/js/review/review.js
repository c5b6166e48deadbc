/**
 * Review: a queue of proposals. One key accepts a correct one; a wrong one can be rejected, deleted or corrected.
 *
 * This file assembles the parts. The desk (desk.js) holds the selection and saves, the queue (queue.js) provides the
 * next item, opening.js opens frames, commands.js holds what keys and buttons do. The other parts draw,
 * and pass on the operator's actions.
 */

import { createAttributes } from "../attributes.js";
import { h } from "../dom.js";
import { createFrameProblem } from "../frame_problem.js";
import { makeHash } from "../router.js";
import { createActions } from "./actions.js";
import { createCommands } from "./commands.js";
import { createDesk, isOpen } from "./desk.js";
import { createFields } from "./fields.js";
import { createFollow } from "./follow.js";
import { createImagePanel } from "./image_panel.js";
import { createOpening } from "./opening.js";
import { createOrthoViews } from "./ortho_views.js";
import { createPreload } from "./preload.js";
import { createQueue } from "./queue.js";
import { createScene } from "./scene.js";
import { createSheet } from "./sheet.js";
import { createBoxList, createQueueList } from "./side_lists.js";
import { createTracks } from "./tracks.js";

/** A picture with a greater ratio of width to height gets a wider panel. */
const WIDE_ASPECT = 1.9;

export function mount(/** @type {HTMLElement} */ root, /** @type {ModeApp} */ app) {
  const project = app.state.route.project;
  root.classList.add("fixed");
  if (app.state.project.frames === 0) {
    root.append(emptyProject());
    return { unmount() {} };
  }
  const parts = layout(project);
  root.append(parts.root);
  const desk = createDesk(app);
  const queue = createQueue(app, showQueue);
  const opening = createOpening(app, {
    desk,
    queue,
    onLoading() {
      showBusy();
      showActions();
    },
    onOpened: showAll,
    onProblem(error, frame) {
      scene.fail(frame);
      if (error === null) problem.hide();
      else problem.show(error);
    },
  });
  const { go } = opening;
  const goInQueue = (/** @type {Target} */ target) => go(target, true);
  const queueList = createQueueList(parts.queue, app, queue, { open: goInQueue });
  const boxList = createBoxList(parts.boxes, app, desk);
  const preload = createPreload(app, desk, queue);
  const sheet = createSheet(app, {
    desk,
    queue,
    preload,
    open: goInQueue,
    isFollowed: (track) => follow.isFollowed(track),
  });
  const tracks = createTracks(parts.boxes, app, desk, {
    open: go,
    sheet: () => commands.whenCalm(sheet.show),
    async onCarried() {
      // they have new uids
      await queue.load();
      sheet.again();
    },
  });
  const follow = createFollow(parts.boxes, app, desk, {
    open: go,
    onFirst(target) {
      if (sheet.again()) return;
      // what is open here comes first
      if (desk.labels().some(isOpen)) opening.pick(null);
      else void goInQueue(target);
    },
    onProgress: () => tracks.refresh(),
  });
  const image = createImagePanel(parts.image, app, desk, {
    onDrawn: (box) => commands.fitDrawn(box),
    onMode: () => showActions(),
    canDraw: () => commands.canDraw(),
  });
  const scene = createScene(parts.scene, app, desk);
  const ortho = createOrthoViews(parts.ortho, app, desk, preload);
  const problem = createFrameProblem(image.body, {
    onRetry: () => opening.broken !== null && void opening.open(opening.broken, null),
    onStep: opening.step,
  });
  const fields = createFields(parts.fields, desk, {
    classes: () => app.state.project.classes,
    up: () => app.state.frame?.up ?? null,
  });
  const attributes = createAttributes(fields.attributes, app, {
    shown: () => desk.shown,
    set: desk.setValues,
    setClass: (label) => desk.shown !== null && void desk.edit({ label }),
  });
  /**
   * The labels before an undo.
   *
   * @type {{ frame: number, labels: Map<string, string> } | null}
   */
  let seen = null;

  const commands = createCommands(app, { desk, queue, opening, follow, image, ortho, root: parts.root });
  const actions = createActions(parts.actions, {
    ...commands,
    accept: () => commands.decide("accept"),
    reject: () => commands.decide("reject"),
    remove: () => commands.decide("delete"),
    gizmo: setGizmo,
    follow: () => commands.followOne("forward"),
  });

  // -- showing

  function showQueue() {
    showActions();
    queueList.show(desk.uid);
    parts.done.hidden = queue.items.length > 0 || queue.isFiltered || opening.loading || !opening.seenQueue;
  }

  function showActions() {
    actions.show({
      label: desk.shown,
      frame: app.state.frame,
      gizmoMode: scene.gizmo,
      busy: opening.loading,
      isDrawing: image.isDrawing,
      isMoreOpen: queue.items.length > 0 || desk.labels().some(isOpen),
    });
  }

  function showBusy() {
    parts.saving.textContent = desk.isSaving ? "saving …" : opening.loading ? "opening …" : "";
  }

  function setGizmo(/** @type {Api.Gizmo} */ mode) {
    scene.setGizmo(mode);
    showActions();
  }

  function showAll() {
    const picture = app.state.frame?.image;
    parts.root.classList.toggle("wide", picture !== undefined && picture.width > WIDE_ASPECT * picture.height);
    image.show();
    boxList.show();
    fields.show();
    attributes.show();
    void tracks.show();
    showQueue();
    // not the old frame again while the next one is being opened
    if (!opening.loading) scene.show();
    void ortho.show();
  }

  const stop = [
    desk.on((what) => {
      if (what === "saving") {
        showBusy();
      } else if (what === "draft") {
        image.show();
        boxList.show();
        ortho.follow();
        fields.show();
        attributes.show();
        scene.preview();
        if (!desk.hasDraft) void ortho.show();
      } else {
        if (what === "selection") queue.visit(desk.uid);
        showAll();
      }
    }),
    app.state.on("frame", (frame) => {
      if (!frame) return;
      desk.settle();
      queue.settle(frame);
      selectWhatWasUndone(frame);
    }),
    app.state.on("project", () => {
      queueList.fill();
      fields.fill();
      showAll();
    }),
    app.events.on("classes", ({ renamed }) => {
      desk.rename(renamed);
      queue.reloadSoon();
      desk.refresh().catch(app.toast);
    }),
    app.events.on("frame", () => {
      queue.reloadSoon();
      desk.refresh().catch(app.toast);
    }),
    app.events.on("reconnected", () => {
      queue.reloadSoon();
      desk.refresh().catch(app.toast);
    }),
    app.keys.register(bindings({ commands, opening, tracks, sheet, image, ortho, setGizmo, attributes })),
  ];

  /** Selects the label that an undo or redo has changed. */
  function selectWhatWasUndone(/** @type {FrameState} */ frame) {
    if (!seen) return;
    const before = seen;
    seen = null;
    if (before.frame !== frame.frame.id) return;
    const changed = frame.labels.find((label) => before.labels.get(label.uid) !== fingerprint(label));
    if (changed) desk.select(changed.uid);
  }

  showActions();
  opening.begin().catch((error) => app.toast(error));

  return {
    route(/** @type {Route} */ { frame, query }) {
      const uid = query.get("uid");
      if (frame === null) void opening.begin().catch(app.toast);
      else if (frame !== opening.opened && frame !== opening.broken)
        void opening.open(frame, uid).then((isOpen) => {
          if (isOpen === false && opening.opened !== null) app.stay(opening.opened);
        });
      else if (uid) desk.select(uid);
    },
    unsaved: () => desk.unsaved && { ...desk.unsaved, retry: desk.retryAll, discard: desk.discardAll },
    async flush() {
      await desk.flush();
      if (app.state.frame)
        seen = {
          frame: app.state.frame.frame.id,
          labels: new Map(desk.labels().map((label) => [label.uid, fingerprint(label)])),
        };
    },
    unmount() {
      for (const end of stop) end();
      queue.end();
      follow.destroy();
      scene.destroy();
      ortho.destroy();
      preload.stop();
      boxList.destroy();
      image.destroy();
      app.events.openFrame(null);
    },
  };
}

const fingerprint = (/** @type {PageLabel} */ { state, label, track_id, box }) =>
  JSON.stringify([state, label, track_id, box]);

// -- its panels

export function layout(/** @type {string} */ project) {
  const part = (/** @type {string} */ name, /** @type {string} */ label) =>
    h("section", { class: `panel ${name}`, "aria-label": label });
  const queue = part("queue", "Queue");
  const boxes = part("frame-boxes", "Boxes of this frame");
  const imagePanel = part("image", "Camera image");
  const scene = part("scene", "3D view");
  const ortho = h("div", { class: "orthos", "data-testid": "orthos" });
  const fields = part("fields", "Selected box");
  const actions = h("div", { class: "actions", role: "toolbar", "aria-label": "Actions" });
  const saving = h("span", { class: "muted", role: "status", "data-testid": "saving" });
  const done = h(
    "div",
    { class: "done-note", hidden: true, role: "status", "data-testid": "review-done" },
    "No proposals left to review. ",
    h("a", { href: makeHash(project, "train") }, "Propose more"),
    " or ",
    h("a", { href: makeHash(project, "export") }, "export"),
    ".",
  );
  const root = h(
    "div",
    { class: "review" },
    h("div", { class: "side" }, queue, boxes),
    h("div", { class: "pictures" }, imagePanel, scene),
    h("div", { class: "bar" }, actions, done, saving),
    h("div", { class: "details" }, ortho, fields),
  );
  return { root, queue, boxes, image: imagePanel, scene, ortho, fields, actions, saving, done };
}

/** Shown in place of the panels if the project has no frame. */
export function emptyProject() {
  return h(
    "div",
    { class: "empty" },
    h("h2", {}, "There is nothing to review yet"),
    h("p", {}, "Add a recording to the project, label a few objects, and let the detectors propose the rest."),
    h("a", { class: "button", href: "#/" }, "Add a recording"),
  );
}

// -- its keys

/**
 * @param {object} parts
 * @param {ReturnType<typeof import("./commands.js").createCommands>} parts.commands
 * @param {Opening} parts.opening
 * @param {ReturnType<typeof import("./tracks.js").createTracks>} parts.tracks
 * @param {ReturnType<typeof import("./sheet.js").createSheet>} parts.sheet
 * @param {ReturnType<typeof import("./image_panel.js").createImagePanel>} parts.image
 * @param {ReturnType<typeof import("./ortho_views.js").createOrthoViews>} parts.ortho
 * @param {(mode: Api.Gizmo) => void} parts.setGizmo
 * @param {ReturnType<typeof import("../attributes.js").createAttributes>} parts.attributes
 */
export function bindings({ commands, opening, tracks, sheet, image, ortho, setGizmo, attributes }) {
  // a key that is held down acts on one box only, not on the following ones
  const once =
    (/** @type {(key: string) => unknown} */ fn) =>
    (/** @type {KeyboardEvent} */ event, /** @type {string} */ key) => {
      if (!event.repeat) fn(key);
    };
  return {
    accept: once(() => commands.decide("accept")),
    "accept-all": once(() => commands.whenCalm(commands.acceptAll)),
    reject: once(() => commands.decide("reject")),
    delete: once(() => commands.decide("delete")),
    refit: once(commands.refit),
    flip: once(commands.flip),
    class: (/** @type {KeyboardEvent} */ _, /** @type {string} */ key) => commands.setClass(key),
    attribute: (/** @type {KeyboardEvent} */ _, /** @type {string} */ key) => attributes.press(key),
    cancel: commands.cancel,
    finalise: once(commands.finalise),
    "copy-previous": once(commands.copy),
    follow: once(() => commands.followOne("forward")),
    "follow-back": once(() => commands.followOne("backward")),
    "follow-all": once(() => commands.followAll("forward")),
    "follow-all-back": once(() => commands.followAll("backward")),
    "copy-next": once(() => commands.whenCalm(() => tracks.copyToNext())),
    carry: once(() => commands.whenCalm(() => tracks.carry())),
    interpolate: once(() => commands.whenCalm(() => tracks.interpolate())),
    "interpolate-refit": once(() => commands.whenCalm(() => tracks.interpolate(true))),
    sheet: once(() => commands.whenCalm(sheet.show)),
    "next-of-track": once(() => commands.whenCalm(() => tracks.step(1))),
    "previous-of-track": once(() => commands.whenCalm(() => tracks.step(-1))),
    "next-box": () => commands.stepBox(1),
    "previous-box": () => commands.stepBox(-1),
    "next-frame": () => opening.step("next"),
    "previous-frame": () => opening.step("previous"),
    "draw-box": once(commands.draw),
    "gizmo-translate": () => setGizmo("translate"),
    "gizmo-rotate": () => setGizmo("rotate"),
    "gizmo-off": () => setGizmo("off"),
    fit: () => {
      image.fit();
      ortho.fit();
    },
  };
}
