/**
 * Review: a queue of proposals, one key for a right one, and every way to mend a wrong one.
 *
 * This file puts the parts together: the desk (desk.js) knows what is selected and saves, the queue (queue.js) knows what
 * comes next, the others draw and pass on what the operator does.
 */

import { headingTurned, sameBox } from "../box3d.js";
import { confirm } from "../dialogs.js";
import { count, h } from "../dom.js";
import { createFrameProblem, frameBeside } from "../frame_problem.js";
import { makeHash } from "../router.js";
import { createActions } from "./actions.js";
import { createDesk, isOpen } from "./desk.js";
import { createFields } from "./fields.js";
import { createImagePanel } from "./image_panel.js";
import { createOrthoViews } from "./ortho_views.js";
import { createQueue } from "./queue.js";
import { createScene } from "./scene.js";
import { createBoxList, createQueueList } from "./side_lists.js";
import { createTracks } from "./tracks.js";

/** A picture that is wider than this, as a share of its height, gets more of the room. */
const WIDE_ASPECT = 1.9;

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
  const queue_list = createQueueList(parts.queue, app, queue, { open: (item) => go(item) });
  const box_list = createBoxList(parts.boxes, desk);
  const tracks = createTracks(parts.boxes, app, desk, { open: (item) => go(item) });
  const image = createImagePanel(parts.image, app, desk, { onDrawn: fitDrawn, onMode: () => showActions() });
  const scene = createScene(parts.scene, app, desk);
  const ortho = createOrthoViews(parts.ortho, app, desk);
  const problem = createFrameProblem(image.body, { onRetry: () => void open(broken), onStep: step });
  const fields = createFields(parts.fields, desk, { classes: () => app.state.project.classes, up: () => app.state.frame?.up ?? null });
  let loading = false;
  let openings = 0;
  let opened = null;
  let broken = null;
  let seen_queue = false;
  let seen = null;

  const act = {
    accept: () => decide("accept"),
    reject: () => decide("reject"),
    remove: () => decide("delete"),
    refit,
    flip: () => desk.shown && desk.edit({ box: headingTurned(desk.shown.box) }),
    gizmo: (mode) => {
      scene.setGizmo(mode);
      showActions();
    },
    copy,
    next: () => whenCalm(() => tracks.follow("detect")),
    draw: () => image.draw(image.drawing === null && canDraw() ? (desk.shown?.label ?? app.state.project.classes[0]) : null),
    finalise,
  };
  const actions = createActions(parts.actions, act);

  // -- what is shown

  function showQueue() {
    queue_list.show(desk.uid);
    parts.done.hidden = queue.items.length > 0 || loading || !seen_queue;
  }

  function showActions() {
    actions.show({ label: desk.shown, frame: app.state.frame, gizmo_mode: scene.gizmo, busy: loading, is_drawing: image.drawing !== null });
  }

  function showBusy() {
    parts.saving.textContent = desk.isSaving ? "saving …" : loading ? "opening …" : "";
  }

  /** While the next frame is on its way, no key decides about a box that nobody has seen. */
  function setLoading(value) {
    loading = value;
    showBusy();
    showActions();
  }

  function showAll() {
    const picture = app.state.frame?.image;
    parts.root.classList.toggle("wide", Boolean(picture) && picture.width > WIDE_ASPECT * picture.height);
    image.show();
    box_list.show();
    fields.show();
    void tracks.show();
    showActions();
    showQueue();
    // not the old frame once more while the next one is on its way
    if (!loading) scene.show();
    void ortho.show();
  }

  const stop = [
    desk.on((what) => {
      if (what === "saving") {
        showBusy();
      } else if (what === "draft") {
        image.show();
        box_list.show();
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

  /** The label that an undo or redo has changed is what the operator wants to see next. */
  function selectWhatWasUndone(frame) {
    if (!seen) return;
    const before = seen;
    seen = null;
    if (before.frame !== frame.frame.id) return;
    const changed = frame.labels.find((label) => before.labels.get(label.uid) !== fingerprint(label));
    if (changed) desk.select(changed.uid);
  }

  // -- where one is

  /** Resolves to false where the operator stays at the frame before, to null where another frame is being opened instead. */
  async function open(id, uid) {
    const own = (openings += 1);
    setLoading(true);
    try {
      if (opened !== id && opened !== null && !(await app.mayLeave())) return false;
      await desk.flush();
      if (own !== openings) return null;
      // what another mode has left in app.state may be old
      if (opened !== id || !desk.stored(uid)) {
        desk.select(null);
        await app.loadFrame(id);
        opened = id;
        showProblem(null);
      }
      pick(uid);
    } catch (error) {
      if (own !== openings || error.name === "AbortError") return null;
      showProblem(error, id);
    } finally {
      if (own === openings) {
        setLoading(false);
        showAll();
      }
    }
    return true;
  }

  /** A frame that cannot be read: the panels say so in place of its pictures. */
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

  /** Selects a label of the open frame: the one that is asked for, or the first that wants a decision. */
  function pick(uid) {
    const labels = desk.labels();
    const chosen = labels.find((label) => label.uid === uid) ?? mostDoubtful(labels.filter(isOpen)) ?? labels.find(({ state }) => state !== "rejected");
    desk.select(chosen?.uid ?? null);
  }

  /** Opens an item of the queue, and writes it into the address. */
  async function go({ frame, uid }) {
    if (frame === opened && desk.stored(uid)) desk.select(uid);
    else if (!(await open(frame, uid))) return;
    app.go(makeHash(project, "review", frame));
  }

  async function step(which) {
    const next = broken === null ? (app.state.frame?.frame[which] ?? null) : await frameBeside(app, broken, which);
    if (next === null) app.toast(which === "next" ? "This is the recording's last frame." : "This is the recording's first frame.");
    else app.go(makeHash(project, "review", next));
  }

  function stepBox(by) {
    const uids = desk.labels().map(({ uid }) => uid);
    if (uids.length === 0) return;
    const at = uids.indexOf(desk.uid);
    desk.select(uids[at < 0 ? (by > 0 ? 0 : uids.length - 1) : (at + by + uids.length) % uids.length]);
  }

  // -- what one does

  /** Accepts, rejects or deletes the selected box, and goes on; an edit that waits is an answer too. */
  async function decide(kind) {
    const label = desk.shown;
    if (!label || loading) return;
    const { id: frame } = app.state.frame.frame;
    const before = openings;
    const saved = save(kind, label);
    const next = queue.after(label.uid);
    // a box on the same picture is there at once; another frame only after this one is safe
    if (next?.frame === frame) desk.select(next.uid);
    else if (next) setLoading(true);
    const is_saved = await saved;
    // the operator has asked for another frame meanwhile
    if (before !== openings) return;
    if (!is_saved) {
      setLoading(false);
      if (app.state.frame?.frame.id === frame) desk.select(label.uid);
      return;
    }
    if (next && next.frame !== frame) await go(next);
    else if (!next && kind === "delete") pick(null);
  }

  const isReviewed = ({ state }) => state === "accepted" || state === "edited";

  function save(kind, label) {
    // a new box is stored with what is drafted of it
    if (kind === "accept" && desk.hasDraft && !label.is_new) return desk.commit().then((is_saved) => (is_saved && desk.stored(label.uid) && !isReviewed(desk.stored(label.uid)) ? desk.decide("accept", label.uid) : is_saved));
    if (kind === "accept" && isReviewed(label)) return Promise.resolve(true);
    if (kind === "reject" && label.state === "rejected") return Promise.resolve(true);
    return desk.decide(kind, label.uid);
  }

  async function refit() {
    const label = desk.shown;
    if (!label) return;
    const { id } = app.state.frame.frame;
    try {
      const { box, note } = await app.api.post(app.path("frames", id, "refit"), { box: label.box, label: label.label });
      if (desk.uid !== label.uid) return;
      if (!sameBox(desk.shown.box, label.box)) {
        app.toast("The box was changed while it was fitted: press G again to fit it from there.", "warn");
        return;
      }
      await desk.edit({ box });
      if (note) app.toast(note, "info");
    } catch (error) {
      app.toast(error);
    }
  }

  /** While a frame is on its way nothing is asked of it. */
  const whenCalm = (fn) => (loading ? undefined : void fn());

  const canDraw = () => Boolean(app.state.frame) && !loading && !app.state.frame.frame.finalised;

  /** A box was drawn on the image. What is not found in it is drawn on in Label, of which this is the first drag. */
  async function fitDrawn(image_box) {
    const { id } = app.state.frame.frame;
    try {
      const { note, ...found } = await app.api.post(app.path("frames", id, "fit"), { image_box });
      if (app.state.frame?.frame.id !== id || !parts.root.isConnected) return;
      if (found.box) {
        desk.add({ ...found, label: image_box.label, image_box });
      } else {
        app.toast(`${note[0].toUpperCase()}${note.slice(1)}: go on here with four drags on its views.`, "warn");
        app.go(makeHash(project, "label", id), { project, frame: id, image_box });
      }
    } catch (error) {
      app.toast(error);
    }
  }

  async function copy() {
    if (app.state.frame?.frame.previous == null) return;
    try {
      const added = await desk.copyPrevious();
      app.toast(added > 0 ? `${count(added, "box", "boxes")} copied from the previous frame` : "The previous frame has no box that is missing here.");
    } catch (error) {
      app.toast(error);
    }
  }

  async function finalise() {
    if (!app.state.frame) return;
    const { frame } = app.state.frame;
    const left = desk.labels().filter(isOpen).length;
    if (!frame.finalised && left > 0 && !(await confirm("Finalise the frame", `${count(left, "proposal")} of this frame ${left === 1 ? "is" : "are"} not reviewed yet.`, "Finalise anyway"))) return;
    if (await desk.finalise(!frame.finalised)) app.toast(frame.finalised ? "The frame is open again." : "The frame is finalised.", "good");
  }

  function setClass(key) {
    const name = app.state.project.classes[Number(key) - 1];
    if (name && image.drawing !== null) image.draw(name);
    else if (name && desk.shown && desk.shown.label !== name) void desk.edit({ label: name });
  }

  /** Takes back what is going on: a drag, then an edit that is not saved, then the selection. */
  function cancel() {
    if (ortho.cancel() || image.cancel()) return;
    if (desk.hasDraft) desk.revert();
    else desk.select(null);
  }

  function keys() {
    // a key that is held down decides about one box, not about all that follow
    const once = (fn) => (event, key) => event.repeat || void fn(key);
    return {
      accept: once(act.accept),
      reject: once(act.reject),
      delete: once(act.remove),
      refit: once(refit),
      flip: once(act.flip),
      class: (_, key) => setClass(key),
      cancel,
      finalise: once(finalise),
      "copy-previous": once(copy),
      "propose-next": once(act.next),
      "copy-next": once(() => whenCalm(() => desk.stored() && !desk.shown.is_new && tracks.follow("copy", desk.uid))),
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
    // the frame can be worked on where its place in the queue is not known
    await queue.load().then(() => (seen_queue = true), app.toast);
    if (frame !== null) return open(frame, query.get("uid") ?? queue.items.find((item) => item.frame === frame)?.uid);
    if (queue.items[0]) return go(queue.items[0]);
    const { frames } = await app.api.get(`${app.path("frames")}?limit=1`);
    return go({ frame: frames[0].id, uid: null });
  }

  parts.done.replaceChildren("Nothing is left to review. ", h("a", { href: makeHash(project, "train") }, "Propose more"), " or ", h("a", { href: makeHash(project, "export") }, "export"), ".");
  showActions();
  begin().catch((error) => app.toast(error));

  return {
    route({ frame, query }) {
      const uid = query.get("uid");
      if (frame === null) void begin().catch(app.toast);
      else if (frame !== opened && frame !== broken) void open(frame, uid).then((is_open) => is_open === false && app.stay(opened));
      else if (uid) desk.select(uid);
    },
    unsaved: () => desk.unsaved && { ...desk.unsaved, retry: desk.retryAll, discard: desk.discardAll },
    async flush() {
      await desk.flush();
      if (app.state.frame) seen = { frame: app.state.frame.frame.id, labels: new Map(desk.labels().map((label) => [label.uid, fingerprint(label)])) };
    },
    unmount() {
      stop.forEach((end) => end());
      queue.end();
      scene.destroy();
      ortho.destroy();
      image.destroy();
      app.events.openFrame(null);
    },
  };
}

const fingerprint = ({ state, label, track_id, box }) => JSON.stringify([state, label, track_id, box]);

const mostDoubtful = (labels) => labels.toSorted((a, b) => (b.doubt ?? 0) - (a.doubt ?? 0))[0];

function layout() {
  const part = (tag, name, label) => h(tag, { class: `panel ${name}`, "aria-label": label });
  const queue = part("section", "queue", "Queue");
  const boxes = part("section", "frame-boxes", "Boxes of this frame");
  const image_panel = part("section", "image", "Camera image");
  const scene = part("section", "scene", "3D view");
  const ortho = h("div", { class: "orthos", "data-testid": "orthos" });
  const fields = part("section", "fields", "Selected box");
  const actions = h("div", { class: "actions", role: "toolbar", "aria-label": "Actions" });
  const saving = h("span", { class: "muted", role: "status", "data-testid": "saving" });
  const done = h("div", { class: "done-note", hidden: true, role: "status", "data-testid": "review-done" });
  const root = h(
    "div",
    { class: "review" },
    h("div", { class: "side" }, queue, boxes),
    h("div", { class: "pictures" }, image_panel, scene),
    h("div", { class: "bar" }, actions, done, saving),
    h("div", { class: "details" }, ortho, fields),
  );
  return { root, queue, boxes, image: image_panel, scene, ortho, fields, actions, saving, done };
}

function emptyProject() {
  return h("div", { class: "empty" }, h("h2", {}, "There is nothing to review yet"), h("p", {}, "Add a recording to the project first; then label a few objects and let the detectors propose the rest."), h("a", { class: "button", href: "#/" }, "Add a recording"));
}
