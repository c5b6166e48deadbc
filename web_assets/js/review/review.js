/**
 * Review: a queue of proposals. One key accepts a correct one; a wrong one can be rejected, deleted or corrected.
 *
 * This file assembles the parts. The desk (desk.js) holds the selection and saves, the queue (queue.js) provides the
 * next item, and the other parts draw and pass on the operator's actions.
 */

import { headingTurned, sameBox } from "../box3d.js";
import { confirm } from "../dialogs.js";
import { count, h } from "../dom.js";
import { isAborted } from "../errors.js";
import { createFrameProblem, frameBeside } from "../frame_problem.js";
import { currentFrame } from "../frame_state.js";
import { makeHash } from "../router.js";
import { createActions } from "./actions.js";
import { createDesk, isOpen } from "./desk.js";
import { createFields } from "./fields.js";
import { createFollow } from "./follow.js";
import { createImagePanel } from "./image_panel.js";
import { createOrthoViews } from "./ortho_views.js";
import { createQueue } from "./queue.js";
import { createScene } from "./scene.js";
import { createBoxList, createQueueList } from "./side_lists.js";
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
  const parts = layout();
  root.append(parts.root);
  const desk = createDesk(app);
  const queue = createQueue(app, showQueue);
  const queueList = createQueueList(parts.queue, app, queue, { open: (item) => go(item) });
  const boxList = createBoxList(parts.boxes, desk);
  const tracks = createTracks(parts.boxes, app, desk, { open: (item) => go(item) });
  const follow = createFollow(parts.boxes, app, desk, {
    open: (item) => go(item),
    onProgress: () => tracks.refresh(),
  });
  const image = createImagePanel(parts.image, app, desk, { onDrawn: fitDrawn, onMode: () => showActions() });
  const scene = createScene(parts.scene, app, desk);
  const ortho = createOrthoViews(parts.ortho, app, desk);
  const problem = createFrameProblem(image.body, {
    onRetry: () => broken !== null && void open(broken, null),
    onStep: step,
  });
  const fields = createFields(parts.fields, desk, {
    classes: () => app.state.project.classes,
    up: () => app.state.frame?.up ?? null,
  });
  let loading = false;
  let openings = 0;
  /**
   * The frame that is shown.
   *
   * @type {number | null}
   */
  let opened = null;
  /**
   * The frame that cannot be read.
   *
   * @type {number | null}
   */
  let broken = null;
  let seenQueue = false;
  /**
   * The labels before an undo.
   *
   * @type {{ frame: number, labels: Map<string, string> } | null}
   */
  let seen = null;

  const act = {
    accept: () => decide("accept"),
    reject: () => decide("reject"),
    remove: () => decide("delete"),
    refit,
    flip: () => desk.shown && desk.edit({ box: headingTurned(desk.shown.box) }),
    /** @param {Api.Gizmo} mode */
    gizmo(mode) {
      scene.setGizmo(mode);
      showActions();
    },
    copy,
    follow: () => followOne("forward"),
    draw: () =>
      image.draw(image.drawing === null && canDraw() ? (desk.shown?.label ?? app.state.project.classes[0]) : null),
    finalise,
  };
  const actions = createActions(parts.actions, act);

  // -- showing

  function showQueue() {
    queueList.show(desk.uid);
    parts.done.hidden = queue.items.length > 0 || loading || !seenQueue;
  }

  function showActions() {
    actions.show({
      label: desk.shown,
      frame: app.state.frame,
      gizmoMode: scene.gizmo,
      busy: loading,
      isDrawing: image.drawing !== null,
    });
  }

  function showBusy() {
    parts.saving.textContent = desk.isSaving ? "saving …" : loading ? "opening …" : "";
  }

  /**
   * Sets whether a frame is being opened; keys must not act meanwhile, because its boxes are not shown yet.
   *
   * @param {boolean} value
   */
  function setLoading(value) {
    loading = value;
    showBusy();
    showActions();
  }

  function showAll() {
    const picture = app.state.frame?.image;
    parts.root.classList.toggle("wide", picture !== undefined && picture.width > WIDE_ASPECT * picture.height);
    image.show();
    boxList.show();
    fields.show();
    void tracks.show();
    showActions();
    showQueue();
    // not the old frame again while the next one is being opened
    if (!loading) scene.show();
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
    app.events.on("frame", (message) => {
      queue.reloadSoon();
      if (app.state.frame?.frame.id === message.frame) desk.refresh().catch(app.toast);
    }),
    app.events.on("reconnected", () => {
      queue.reloadSoon();
      desk.refresh().catch(app.toast);
    }),
    app.keys.register(keys()),
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

  // -- opening

  /**
   * Opens a frame. Resolves to false if the operator stays with the open one, to null if yet another one is opened.
   *
   * @param {number} id
   * @param {string | null} uid
   */
  async function open(id, uid) {
    openings += 1;
    const own = openings;
    setLoading(true);
    try {
      if (opened !== id && opened !== null && !(await app.mayLeave())) return false;
      await desk.flush();
      if (own !== openings) return null;
      // app.state may still have an old state from another mode
      if (opened !== id || !desk.stored(uid)) {
        desk.select(null);
        await app.loadFrame(id);
        opened = id;
        showProblem(null);
      }
      pick(uid);
    } catch (error) {
      if (own !== openings || isAborted(error)) return null;
      showProblem(error, id);
    } finally {
      if (own === openings) {
        setLoading(false);
        showAll();
      }
    }
    return true;
  }

  /**
   * Shows the reason why a frame cannot be read, in place of its pictures; null: it can be read.
   *
   * @param {unknown} error
   * @param {number | null} [frame]
   */
  function showProblem(error, frame = null) {
    broken = frame;
    scene.fail(frame);
    if (error === null) {
      problem.hide();
      return;
    }
    opened = null;
    problem.show(error);
  }

  /**
   * Selects a label of the open frame: this one, or else the most doubtful proposal.
   *
   * @param {string | null} uid
   */
  function pick(uid) {
    const labels = desk.labels();
    const chosen =
      labels.find((label) => label.uid === uid) ??
      mostDoubtful(labels.filter(isOpen)) ??
      labels.find(({ state }) => state !== "rejected");
    desk.select(chosen?.uid ?? null);
  }

  /**
   * Opens a box, and puts its frame into the address.
   *
   * @param {Target} options
   */
  async function go({ frame, uid }) {
    if (frame === opened && desk.stored(uid)) desk.select(uid);
    else if (!(await open(frame, uid))) return;
    app.go(makeHash(project, "review", frame));
  }

  /** @param {Direction} which */
  async function step(which) {
    const next = broken === null ? (app.state.frame?.frame[which] ?? null) : await frameBeside(app, broken, which);
    if (next === null)
      app.toast(which === "next" ? "This is the recording's last frame." : "This is the recording's first frame.");
    else app.go(makeHash(project, "review", next));
  }

  /** @param {number} by */
  function stepBox(by) {
    const uids = desk.labels().map(({ uid }) => uid);
    if (uids.length === 0) return;
    const at = uids.indexOf(desk.uid ?? "");
    desk.select(uids[at < 0 ? (by > 0 ? 0 : uids.length - 1) : (at + by + uids.length) % uids.length]);
  }

  // -- actions

  /**
   * Accepts, rejects or deletes the selected box, and goes to the next one. Saving a draft counts as accepting.
   *
   * @param {"accept" | "reject" | "delete"} kind
   */
  async function decide(kind) {
    const label = desk.shown;
    if (!label || loading) return;
    const { id: frame } = currentFrame(app).frame;
    const before = openings;
    const saved = save(kind, label);
    const next = queue.after(label.uid);
    // a box of the same frame is selected at once; another frame is opened after saving
    if (next?.frame === frame) desk.select(next.uid);
    else if (next) setLoading(true);
    const isSaved = await saved;
    // the operator has opened another frame in the meantime
    if (before !== openings) return;
    if (!isSaved) {
      setLoading(false);
      if (app.state.frame?.frame.id === frame) desk.select(label.uid);
      return;
    }
    if (next && next.frame !== frame) await go(next);
    else if (!next && kind === "delete") pick(null);
  }

  /** @param {PageLabel} label */
  const isReviewed = ({ state }) => state === "accepted" || state === "edited";

  /**
   * @param {"accept" | "reject" | "delete"} kind
   * @param {PageLabel} label
   */
  async function save(kind, label) {
    // a new box is stored together with its draft
    if (kind === "accept" && desk.hasDraft && !label.isNew) {
      const isSaved = await desk.commit();
      const stored = desk.stored(label.uid);
      return isSaved && stored && !isReviewed(stored) ? desk.decide("accept", label.uid) : isSaved;
    }
    if (kind === "accept" && isReviewed(label)) return true;
    if (kind === "reject" && label.state === "rejected") return true;
    return desk.decide(kind, label.uid);
  }

  async function refit() {
    const label = desk.shown;
    if (!label) return;
    const { id } = currentFrame(app).frame;
    try {
      /** @type {Api.RefitOut} */
      const { box, note, measured_by } = await app.api.post(app.path("frames", id, "refit"), {
        box: label.box,
        label: label.label,
      });
      if (desk.uid !== label.uid) return;
      if (desk.shown && !sameBox(desk.shown.box, label.box)) {
        app.toast("The box was changed during the fit. Press G to fit it again.", "warn");
        return;
      }
      await desk.edit({ box });
      if (note) app.toast(note, "info");
      else app.toast(`Fitted again. Measured by: ${measured_by}`, "info");
    } catch (error) {
      app.toast(error);
    }
  }

  /**
   * Runs an action unless a frame is being opened.
   *
   * @param {() => unknown} fn
   */
  const whenCalm = (fn) => (loading ? undefined : void fn());

  /** @param {"forward" | "backward"} direction */
  const followOne = (direction) =>
    whenCalm(() => {
      const label = desk.shown;
      if (label && !label.isNew && isReviewed(label)) void follow.start(direction, label.uid);
      else app.toast("Select a reviewed box to follow, or accept this one first.", "warn");
    });

  /** @param {"forward" | "backward"} direction */
  const followAll = (direction) => whenCalm(() => follow.start(direction, null));

  const canDraw = () => app.state.frame !== null && !loading && !app.state.frame.frame.finalised;

  /**
   * A box was drawn on the image. If no object is found in it, it becomes the first of the five drags in Label.
   *
   * @param {Box2D} box
   */
  async function fitDrawn(box) {
    const { id } = currentFrame(app).frame;
    try {
      /** @type {Api.FitOut} */
      const { note, box: fitted, ...facts } = await app.api.post(app.path("frames", id, "fit"), { image_box: box });
      if (app.state.frame?.frame.id !== id || !parts.root.isConnected) return;
      if (fitted) {
        desk.add({ ...facts, box: fitted, label: box.label, image_box: box });
      } else {
        const why = note ? `${note[0].toUpperCase()}${note.slice(1)}` : "No object was found";
        const who = facts.measured_by ? ` (${facts.measured_by})` : "";
        app.toast(`${why}${who}. To finish it by hand, draw boxes on the four views of the image box.`, "warn");
        app.go(makeHash(project, "label", id), { project, frame: id, image_box: box });
      }
    } catch (error) {
      app.toast(error);
    }
  }

  async function copy() {
    if (app.state.frame?.frame.previous == null) return;
    try {
      const added = await desk.copyPrevious();
      app.toast(
        added > 0
          ? `${count(added, "box", "boxes")} copied from the previous frame`
          : "This frame already has all boxes of the previous one.",
      );
    } catch (error) {
      app.toast(error);
    }
  }

  async function finalise() {
    if (!app.state.frame) return;
    const { frame } = app.state.frame;
    const left = desk.labels().filter(isOpen).length;
    if (
      !frame.finalised &&
      left > 0 &&
      !(await confirm(
        "Finalise the frame",
        `${count(left, "proposal")} of this frame ${left === 1 ? "is" : "are"} not reviewed yet.`,
        "Finalise anyway",
      ))
    )
      return;
    if (await desk.finalise(!frame.finalised))
      app.toast(frame.finalised ? "The frame is reopened." : "The frame is finalised.", "good");
  }

  /** @param {string} key */
  function setClass(key) {
    const name = app.state.project.classes[Number(key) - 1];
    if (name && image.drawing !== null) image.draw(name);
    else if (name && desk.shown && desk.shown.label !== name) void desk.edit({ label: name });
  }

  /** Cancels a drag, or else an edit that is not saved, or else deselects. */
  function cancel() {
    if (ortho.cancel() || image.cancel()) return;
    if (desk.hasDraft) desk.revert();
    else desk.select(null);
  }

  function keys() {
    // a key that is held down acts on one box only, not on the following ones
    /** @param {(key: string) => unknown} fn */
    const once = (fn) => (/** @type {KeyboardEvent} */ event, /** @type {string} */ key) => {
      if (!event.repeat) fn(key);
    };
    return {
      accept: once(act.accept),
      reject: once(act.reject),
      delete: once(act.remove),
      refit: once(refit),
      flip: once(act.flip),
      class: (/** @type {KeyboardEvent} */ _, /** @type {string} */ key) => setClass(key),
      cancel,
      finalise: once(finalise),
      "copy-previous": once(copy),
      follow: once(act.follow),
      "follow-back": once(() => followOne("backward")),
      "follow-all": once(() => followAll("forward")),
      "follow-all-back": once(() => followAll("backward")),
      "copy-next": once(() => whenCalm(() => tracks.copyToNext())),
      interpolate: once(() => whenCalm(() => tracks.interpolate())),
      "interpolate-refit": once(() => whenCalm(() => tracks.interpolate(true))),
      "next-of-track": once(() => whenCalm(() => tracks.step(1))),
      "previous-of-track": once(() => whenCalm(() => tracks.step(-1))),
      "next-box": () => stepBox(1),
      "previous-box": () => stepBox(-1),
      "next-frame": () => step("next"),
      "previous-frame": () => step("previous"),
      "draw-box": once(act.draw),
      "gizmo-translate": () => act.gizmo("translate"),
      "gizmo-rotate": () => act.gizmo("rotate"),
      "gizmo-off": () => act.gizmo("off"),
      "points-larger": () => scene.points(1.25),
      "points-smaller": () => scene.points(0.8),
      fit: () => {
        image.fit();
        ortho.fit();
      },
    };
  }

  async function begin() {
    const { frame, query } = app.state.route;
    // the frame can be reviewed without the queue
    try {
      await queue.load();
      seenQueue = true;
    } catch (error) {
      app.toast(error);
    }
    if (frame !== null)
      return open(frame, query.get("uid") ?? queue.items.find((item) => item.frame === frame)?.uid ?? null);
    if (queue.items[0]) return go(queue.items[0]);
    /** @type {Api.FrameListJson} */
    const { frames } = await app.api.get(`${app.path("frames")}?limit=1`);
    return go({ frame: frames[0].id, uid: null });
  }

  parts.done.replaceChildren(
    "No proposals left to review. ",
    h("a", { href: makeHash(project, "train") }, "Propose more"),
    " or ",
    h("a", { href: makeHash(project, "export") }, "export"),
    ".",
  );
  showActions();
  begin().catch((error) => app.toast(error));

  return {
    /** @param {Route} route */
    route({ frame, query }) {
      const uid = query.get("uid");
      if (frame === null) void begin().catch(app.toast);
      else if (frame !== opened && frame !== broken)
        void open(frame, uid).then((isOpen) => {
          if (isOpen === false && opened !== null) app.stay(opened);
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
      image.destroy();
      app.events.openFrame(null);
    },
  };
}

/** @param {PageLabel} label */
const fingerprint = ({ state, label, track_id, box }) => JSON.stringify([state, label, track_id, box]);

/** @param {PageLabel[]} labels */
const mostDoubtful = (labels) => labels.toSorted((a, b) => (b.doubt ?? 0) - (a.doubt ?? 0))[0];

function layout() {
  /**
   * @param {string} name
   * @param {string} label
   */
  const part = (name, label) => h("section", { class: `panel ${name}`, "aria-label": label });
  const queue = part("queue", "Queue");
  const boxes = part("frame-boxes", "Boxes of this frame");
  const imagePanel = part("image", "Camera image");
  const scene = part("scene", "3D view");
  const ortho = h("div", { class: "orthos", "data-testid": "orthos" });
  const fields = part("fields", "Selected box");
  const actions = h("div", { class: "actions", role: "toolbar", "aria-label": "Actions" });
  const saving = h("span", { class: "muted", role: "status", "data-testid": "saving" });
  const done = h("div", { class: "done-note", hidden: true, role: "status", "data-testid": "review-done" });
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

function emptyProject() {
  return h(
    "div",
    { class: "empty" },
    h("h2", {}, "There is nothing to review yet"),
    h("p", {}, "Add a recording to the project, label a few objects, and let the detectors propose the rest."),
    h("a", { class: "button", href: "#/" }, "Add a recording"),
  );
}
