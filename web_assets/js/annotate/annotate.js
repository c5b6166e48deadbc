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
import { askClass } from "../classes/picker.js";
import { button, h } from "../dom.js";
import { createFrameProblem } from "../frame_problem.js";
import { showHints } from "../messages.js";
import { addRecordings } from "../start/recordings.js";
import { createActions } from "./actions.js";
import { createAreas } from "./areas.js";
import { createNextClass } from "./class_picker.js";
import { createCommands } from "./commands.js";
import { createDesk, isOpen } from "./desk.js";
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
import { createTracks, OPERATIONS } from "./tracks.js";

/** Whether the top view is shown in place of the 3D view. */
const MAP_KEPT = "top-view";
/** A picture with a greater ratio of width to height gets a wider place. */
const WIDE_ASPECT = 1.9;

/** For a key that acts on one box only: while it is held down, it does not act on the following ones. */
const once =
  (/** @type {(key: string) => unknown} */ fn) => (/** @type {Event} */ event, /** @type {string} */ key) => {
    if (!(event instanceof KeyboardEvent && event.repeat)) fn(key);
  };

export function mount(/** @type {HTMLElement} */ root, /** @type {ModeApp} */ app) {
  root.classList.add("fixed");
  if (app.state.project.frames === 0) {
    root.append(emptyProject(app));
    return { unmount() {} };
  }
  const parts = layout();
  root.append(parts.root);
  const areas = createAreas(parts.root);
  showHints(parts.problem, parts.hint, parts.saving);
  const desk = createDesk(app);
  const queue = createQueue(app, showQueue);
  const opening = createOpening(app, {
    desk,
    queue,
    onLoading() {
      showBusy();
      if (opening.loading) showActions();
      else showAll();
    },
    onProblem(error, frame) {
      scene.fail(frame);
      if (error === null) problem.hide();
      else problem.show(error);
    },
  });
  const { go } = opening;
  const goInQueue = (/** @type {Target} */ target) => go(target, true);
  const queueList = createQueueList(parts.queue, app, queue, { open: goInQueue });
  const boxList = createBoxList(parts.boxes, app, desk, () => teach, showBest);
  const picker = createNextClass(parts.classes, app);
  const preload = createPreload(app, desk, queue);
  const sheet = createSheet(app, {
    desk,
    queue,
    preload,
    open: goInQueue,
    next: () => (opening.inQueue ? (queue.items[0] ?? null) : null),
    isFollowed: (track) => follow.isFollowed(track),
  });
  const tracks = createTracks(parts.track, app, desk, {
    open: go,
    sheet: () => commands.whenCalm(sheet.show),
    async onChanged() {
      // they may have new uids
      await queue.load();
      sheet.again();
    },
  });
  const follow = createFollow(parts.track, app, desk, {
    open: go,
    onFirst(target) {
      // the operator is on the way to another frame, or draws here
      if (opening.loading || image.isBusy || desk.shown?.isNew || sheet.again()) return;
      // what is open here comes first
      if (desk.labels().some(isOpen)) opening.pick(null);
      else void goInQueue(target);
    },
  });
  const image = createImagePanel(parts.image, app, desk, {
    teach: () => teach,
    nextClass: () => picker.label,
    hint: parts.hint,
    onDrawn: (box) => commands.fitDrawn(box),
    onMode: () => showActions(),
    canDraw: () => commands.canDraw(),
  });
  const scene = createScene(parts.scene, app, desk, () => teach);
  const map = createMap(parts.map, app, desk, {
    onPlace: (point) => commands.placeAt(point),
    onOpen: showBest,
    onClose: () => turnMap(false),
  });
  turnMap(localStorage.getItem(MAP_KEPT) === "true");
  const ortho = createOrthoViews(parts.ortho, app, desk, preload);
  const teach = createTeach(parts.object, app, desk, {
    onChange: showDrawn,
    onTurn(on) {
      parts.ortho.hidden = on;
      if (!on) void ortho.show();
    },
    isImageBusy: () => image.editor.isDragging,
  });
  parts.problem.append(teach.problem);
  const problem = createFrameProblem(image.body, {
    onRetry: () => opening.broken !== null && void opening.open(opening.broken, null),
    onStep: opening.step,
  });
  const fields = createFields(parts.fields, desk, {
    classes: () => app.state.project.classes,
    up: () => app.state.frame?.up ?? null,
    hint: () => teach.hint(),
  });
  const attributes = createAttributes(fields.attributes, app, {
    shown: () => desk.shown,
    set: desk.setValues,
    setClass: (label) => desk.shown !== null && void desk.edit({ label }),
  });
  /** The labels before an undo. @type {{ frame: number, labels: Map<string, string> } | null} */
  let seen = null;

  const commands = createCommands(app, {
    desk,
    queue,
    opening,
    follow,
    image,
    ortho,
    teach,
    map,
    picker,
    root: parts.root,
  });
  /** What the keys do, and the buttons. @type {Record<string, (event: Event, key: string) => unknown>} */
  const bindings = {
    accept: once(() => commands.decide("accept")),
    "accept-all": once(() => commands.whenCalm(commands.acceptAll)),
    reject: once(() => commands.decide("reject")),
    delete: once(() => commands.decide("delete")),
    refit: once(commands.refit),
    turn: once(() => commands.turn(2)),
    "turn-quarter": once(() => commands.turn(1)),
    class: (/** @type {Event} */ _, /** @type {string} */ key) =>
      commands.setClass(app.state.project.classes[Number(key) - 1]),
    "class-search": once(async () => commands.setClass(await askClass(app))),
    attribute: (/** @type {Event} */ _, /** @type {string} */ key) => attributes.press(key),
    cancel: commands.cancel,
    finalise: once(() => commands.whenCalm(commands.finalise)),
    "copy-previous": once(() => commands.whenCalm(commands.copy)),
    follow: once(() => commands.followOne("forward")),
    "follow-back": once(() => commands.followOne("backward")),
    "follow-all": once(() => commands.followAll("forward")),
    "follow-all-back": once(() => commands.followAll("backward")),
    "copy-next": once(() => commands.whenCalm(() => tracks.copyToNext())),
    ...Object.fromEntries(
      Object.entries(OPERATIONS)
        .filter(([, { key }]) => key)
        .map(([id]) => [`track-${id}`, once((key) => commands.whenCalm(() => tracks.operate(id, key)))]),
    ),
    sheet: once(() => commands.whenCalm(sheet.show)),
    "next-of-track": once(() => commands.whenCalm(() => tracks.step(1))),
    "previous-of-track": once(() => commands.whenCalm(() => tracks.step(-1))),
    "next-box": () => commands.stepBox(1),
    "previous-box": () => commands.stepBox(-1),
    "next-camera": once(() => commands.whenCalm(commands.nextCamera)),
    "next-frame": () => opening.step("next"),
    "previous-frame": () => opening.step("previous"),
    "draw-box": once(commands.draw),
    "gizmo-translate": () => setGizmo("translate"),
    "gizmo-rotate": () => setGizmo("rotate"),
    "gizmo-off": () => setGizmo("off"),
    fit: () => {
      image.fit();
      map.fit();
      ortho.fit();
      teach.fit();
    },
    areas: once(areas.swap),
    "top-view": once(() => turnMap(!map.isShown)),
    teach: once(() => teach.turn(!teach.isOn)),
    unlabelled: once(() => commands.whenCalm(commands.nextUnlabelled)),
    "next-whole-box": once(() => teach.nextWhole()),
  };
  const actions = createActions(parts.actions, bindings, teach.turn);
  const topView = button(["Top view", h("kbd", "M")], () => turnMap(true), {
    class: "quiet small",
    title: "A map: click to place a box, drag to move it (M)",
    "data-testid": "show-map",
  });
  parts.sceneHead.append(h("h2", "3D view"), actions.gizmo, h("span.grow"), topView);

  // -- showing

  function showQueue() {
    showActions();
    queueList.show(desk.uid);
  }

  function showActions() {
    actions.show({
      label: desk.shown,
      frame: app.state.frame,
      gizmoMode: scene.gizmo,
      busy: opening.loading,
      isDrawing: image.isDrawing,
      isTeaching: teach.isOn,
      canAccept: teach.canAccept,
      isMoreOpen: (opening.inQueue && queue.items.length > 0) || desk.labels().some(isOpen),
    });
  }

  function showBusy() {
    const isSaving = desk.isSaving || teach.isSaving;
    parts.root.toggleAttribute("data-saving", isSaving);
    parts.saving.textContent = isSaving ? "saving …" : opening.loading ? "opening …" : "";
  }

  /** The object that is drawn has changed. */
  function showDrawn() {
    showBusy();
    if (opening.loading) return;
    image.show();
    boxList.show();
    fields.show();
    showActions();
    scene.show();
  }

  /** Shows the top view in place of the 3D view, or this one again. */
  function turnMap(/** @type {boolean} */ on) {
    localStorage.setItem(MAP_KEPT, String(on));
    parts.scene.hidden = on;
    parts.map.hidden = !on;
    map.turn(on);
  }

  /** Goes to the camera that sees a box of the moment best. */
  function showBest(/** @type {string} */ uid) {
    if (opening.opened !== null && desk.stored(uid)) void go({ frame: opening.opened, uid });
  }

  function setGizmo(/** @type {Api.Gizmo} */ mode) {
    scene.setGizmo(mode);
    showActions();
  }

  function showAll() {
    // the next frame is shown once, when its box is selected
    if (opening.loading) return;
    const picture = app.state.frame?.image;
    parts.root.classList.toggle("wide", picture !== undefined && picture.width > WIDE_ASPECT * picture.height);
    image.show();
    boxList.show();
    picker.show();
    fields.show();
    attributes.show();
    tracks.show();
    const track = desk.stored()?.track_id ?? null;
    if (track !== app.state.track) app.state.set({ track });
    showQueue();
    scene.show();
    map.show();
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
        map.show();
        fields.show();
        attributes.show();
        tracks.show();
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
    }),
    app.state.on("frame", (frame) => {
      if (!frame) return;
      desk.settle();
      teach.settle();
      queue.settle(frame);
      selectWhatWasUndone(frame);
    }),
    app.state.on("project", () => {
      queueList.fill();
      fields.fill();
      teach.show();
      showAll();
    }),
    app.events.on("classes", ({ renamed }) => {
      desk.rename(renamed);
      teach.rename(renamed);
      catchUp();
    }),
    app.events.on("frame", catchUp),
    app.events.on("reconnected", catchUp),
    app.keys.register(bindings),
  ];

  /** Others have saved something. */
  function catchUp() {
    queue.reloadSoon();
    desk.refresh().catch(app.toast);
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

  showActions();
  opening.begin().catch((error) => app.toast(error));

  return {
    route(/** @type {Route} */ { frame, query }) {
      // the boxes of a moment are the same in all its cameras
      const isSameMoment = Object.values(app.state.frame?.frame.cameras ?? {}).includes(frame ?? -1);
      const [uid, track] = [query.get("uid") ?? (isSameMoment ? desk.uid : null), trackIn(query)];
      if (frame === null) void opening.begin().catch(app.toast);
      else if (frame !== opening.opened && frame !== opening.broken)
        void opening.open(frame, uid, track).then((isOpen) => {
          if (isOpen === false && opening.opened !== null) app.stay(opening.opened);
        });
      else if (uid) desk.select(uid);
      else if (track !== null) opening.pick(null, track);
    },
    unsaved() {
      const all = [teach.unsaved, desk.unsaved].filter((one) => one !== null);
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
    unmount() {
      for (const end of stop) end();
      queue.end();
      follow.destroy();
      scene.destroy();
      ortho.destroy();
      preload.stop();
      boxList.destroy();
      teach.destroy();
      map.destroy();
      image.destroy();
      app.events.openFrame(null);
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
