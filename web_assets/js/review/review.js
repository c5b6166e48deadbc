/**
 * Review: a queue of proposals. One key accepts a correct one; a wrong one can be rejected, deleted or corrected.
 *
 * This file assembles the parts. The desk (desk.js) holds the selection and saves, the queue (queue.js) provides the
 * next item, opening.js opens frames, commands.js holds what keys (bindings.js) and buttons do. The other parts draw,
 * and pass on the operator's actions.
 */

import { createAttributes } from "../attributes.js";
import { createFrameProblem } from "../frame_problem.js";
import { createActions } from "./actions.js";
import { bindings } from "./bindings.js";
import { createCommands } from "./commands.js";
import { createDesk, isOpen } from "./desk.js";
import { createFields } from "./fields.js";
import { createFollow } from "./follow.js";
import { createImagePanel } from "./image_panel.js";
import { emptyProject, layout } from "./layout.js";
import { createOpening } from "./opening.js";
import { createOrthoViews } from "./ortho_views.js";
import { createPreload } from "./preload.js";
import { createQueue } from "./queue.js";
import { createScene } from "./scene.js";
import { createBoxList, createQueueList } from "./side_lists.js";
import { createSheet } from "./sheet.js";
import { createTracks } from "./tracks.js";

/** A picture with a greater ratio of width to height gets a wider panel. */
const WIDE_ASPECT = 1.9;

/**
 * @param {HTMLElement} root
 * @param {ModeApp} app
 */
export function mount(root, app) {
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
  /** @param {Target} target */
  const goInQueue = (target) => go(target, true);
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

  /** @param {Api.Gizmo} mode */
  function setGizmo(mode) {
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
    app.keys.register(bindings({ commands, opening, tracks, sheet, scene, image, ortho, setGizmo, attributes })),
  ];

  /**
   * Selects the label that an undo or redo has changed.
   *
   * @param {FrameState} frame
   */
  function selectWhatWasUndone(frame) {
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
    /** @param {Route} route */
    route({ frame, query }) {
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

/** @param {PageLabel} label */
const fingerprint = ({ state, label, track_id, box }) => JSON.stringify([state, label, track_id, box]);
