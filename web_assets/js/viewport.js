/**
 * The 3D view: viser's own page in an iframe of this origin, of which there is one for the whole visit.
 *
 * `element` is only the place of the view in a mode's layout: the iframe itself lies over it in a layer of the page, since
 * an iframe that is moved to another parent starts anew (seconds). Keys that are pressed in the iframe go to the page's key
 * table and never to viser, whose W A S D Q E and arrows would move the camera.
 */

import { h } from "./dom.js";

const FOLLOW_MS = 200;
const RETRY_MS = 1500;
const ASK_MS = 800;
// Drawn at most without a graphics card: a frame takes a processor some 5 us a point. The server draws the few larger.
const SOFTWARE_POINTS = 10000;
// And each pixel counts: so many are drawn for one of the screen's, along each side (a setting of viser's page).
const SOFTWARE_PIXELS = 0.65;
const NO_WEBGL = "This browser cannot draw in 3D (no WebGL 2). The image and the views work without it; for the 3D view turn on hardware acceleration, or use another browser.";
// viser's own panel and notes; nothing in them is for an operator.
const STYLE = ".mantine-Paper-root, [data-floating-window], .mantine-Notifications-root { display: none !important; } canvas { cursor: default !important; outline: none; }";

/**
 * createViewport(app) -> {
 *   element,               put it where the 3D view shall be (it fills its parent)
 *   show(scene),           the body of PUT /api/workbench/ID/scene; the newest wins. Call it again when labels have changed
 *   on(event, handler),    -> function that ends it. Events: `box` {uid, box, final}, `select` {uid}, `shown` {shown_points,
 *                          points, ms}, `state` (opening | ready | lost | unsupported)
 *   id, state,             of the workbench; null before it is open
 *   graphics,              who draws: "card", "software", or "none"
 *   focus(), detach(), destroy()
 * }
 */
export function createViewport(app) {
  const listeners = new Map();
  const note = h("p", { class: "viewport-note", role: "status", "data-testid": "viewport-note" });
  const element = h("div", { class: "viewport-place", "data-testid": "viewport" }, note);
  const layer = h("div", { class: "viewport-layer", hidden: true });
  const place = { text: "" };
  let frame = null;
  let bench = null;
  let wanted = null;
  let last = null;
  let busy = false;
  let state = "opening";
  let retry = 0;
  let gone = false;

  Object.assign(element.style, { position: "absolute", inset: "0", display: "grid", placeItems: "center" });
  Object.assign(note.style, { maxWidth: "36em", padding: "0 2em", textAlign: "center", color: "#c3c9d4" });
  Object.assign(layer.style, { position: "fixed", zIndex: "1", overflow: "hidden", background: "#141414" });
  document.body.append(layer);

  const observer = new ResizeObserver(follow);
  observer.observe(element);
  const timer = setInterval(follow, FOLLOW_MS);
  const endings = [
    app.events.on("viewport", receive),
    app.events.on("reconnected", showAgain),
    listen(window, "resize", follow),
    listen(window, "scroll", follow, { capture: true, passive: true }),
    listen(window, "pagehide", leave),
    () => clearInterval(timer),
    () => clearTimeout(retry),
    () => observer.disconnect(),
  ];
  const graphics = lookAtGraphics();
  if (graphics === "none") say("unsupported", NO_WEBGL);

  function emit(event, value) {
    for (const fn of [...(listeners.get(event) ?? [])]) fn(value);
  }

  /** What the place says while there is no picture. */
  function say(next, text = "") {
    const changed = state !== next;
    state = next;
    note.textContent = text;
    element.dataset.state = next;
    follow();
    if (changed) emit("state", next);
  }

  /** Puts the iframe over its place; hides it where that is not in the page, or there is nothing to see yet. */
  function follow() {
    const rect = element.isConnected ? element.getBoundingClientRect() : null;
    const seen = rect !== null && rect.width > 1 && rect.height > 1 && frame !== null;
    const ready = state === "ready";
    const text = seen ? `${rect.left},${rect.top},${rect.width},${rect.height},${ready}` : "";
    if (text === place.text) return;
    place.text = text;
    layer.hidden = !seen;
    if (!seen) return;
    // viser starts only where it has a size, so it is there and not yet seen
    layer.style.opacity = ready ? "1" : "0";
    layer.style.pointerEvents = ready ? "auto" : "none";
    for (const [side, px] of [["left", rect.left], ["top", rect.top], ["width", rect.width], ["height", rect.height]]) layer.style[side] = `${px}px`;
  }

  function show(scene) {
    if (state === "unsupported" || gone) return;
    wanted = { project: app.state.route.project, scene };
    void work();
  }

  /** Sends what is wanted until nothing newer is. One request at a time: a newer scene waits for the answer to an older. */
  async function work() {
    if (busy) return;
    busy = true;
    clearTimeout(retry);
    try {
      while (wanted !== null && wanted.project !== null && !gone) await step();
    } catch (error) {
      if (error.name !== "ApiError") throw error;
      if (error.status === 404 && bench !== null) {
        // the server was started anew, or had too many open
        forget();
        again();
      } else {
        say("lost", error.message);
        if (error.status === 0 || error.status >= 500) again();
      }
    } finally {
      busy = false;
    }
  }

  async function step() {
    const { project, scene } = wanted;
    if (bench !== null && bench.project !== project) leave();
    if (bench === null) {
      say("opening", "Opening the 3D view …");
      bench = { project, ...(await app.api.post("/api/workbench", { project })) };
      start(bench.url);
      return;
    }
    const newest = wanted;
    const detail = graphics === "software" ? { most_points: SOFTWARE_POINTS } : {};
    const answer = await app.api.put(`/api/workbench/${bench.id}/scene`, { ...detail, ...scene });
    // "back to the first view" is done once
    last = { project, scene: { ...scene, reset_view: false } };
    if (wanted === newest) wanted = null;
    connected(answer.connected);
    // the event that says so may be missed where the page's own socket is just being opened
    if (!answer.connected) retry = setTimeout(showAgain, ASK_MS);
    emit("shown", answer);
  }

  function again() {
    clearTimeout(retry);
    retry = setTimeout(work, RETRY_MS);
  }

  /** The server may have been started anew, and knows nothing of this workbench. */
  function showAgain() {
    if (last !== null && last.project === app.state.route.project) wanted ??= last;
    void work();
  }

  function connected(yes) {
    if (yes) say("ready");
    else if (state === "ready") say("opening", "The 3D view connects again …");
  }

  function receive(message) {
    if (message.workbench !== bench?.id) return;
    if (message.event === "connected") connected(message.connected);
    else emit(message.event, message);
  }

  /** A new iframe for a new workbench. */
  function start(url) {
    frame?.remove();
    frame = h("iframe", { title: "3D view", "data-testid": "viewport-frame", tabindex: "-1" });
    Object.assign(frame.style, { position: "absolute", inset: "0", width: "100%", height: "100%", border: "0" });
    frame.addEventListener("load", () => prepare(frame));
    frame.src = graphics === "software" ? `${url}?fixedDpr=${SOFTWARE_PIXELS}` : url;
    layer.append(frame);
    follow();
  }

  function prepare(loaded) {
    const view = loaded.contentWindow;
    if (view === null || view.location.href === "about:blank") return;
    const style = view.document.createElement("style");
    style.textContent = STYLE;
    view.document.head.append(style);
    app.keys.listen(view);
    app.effort.watch(view);
    // after the key table: whatever it has left is not for viser either
    for (const name of ["keydown", "keyup", "keypress"]) view.addEventListener(name, keep, { capture: true });
  }

  function keep(event) {
    event.stopImmediatePropagation();
    // what scrolls or leaves the iframe
    if (/^( |Arrow.*|Page.*|Home|End)$/.test(event.key)) event.preventDefault();
  }

  function forget() {
    bench = null;
    frame?.remove();
    frame = null;
    follow();
  }

  /** Closes the workbench; the server would do it a minute later by itself. */
  function leave() {
    if (bench === null) return;
    fetch(`/api/workbench/${bench.id}`, { method: "DELETE", keepalive: true, credentials: "same-origin" }).catch(() => {});
    forget();
  }

  return {
    element,
    show,
    on(event, handler) {
      if (!listeners.has(event)) listeners.set(event, new Set());
      listeners.get(event).add(handler);
      return () => listeners.get(event).delete(handler);
    },
    get id() {
      return bench?.id ?? null;
    },
    get state() {
      return state;
    },
    graphics,
    /** Keys work either way; this is for a pointer that shall turn the view with the wheel. */
    focus() {
      frame?.contentWindow?.focus();
    },
    /** Takes the view out of the page; it stays connected and comes back at once. */
    detach() {
      if (element.contains(document.activeElement) || document.activeElement === frame) window.focus();
      element.remove();
      follow();
    },
    destroy() {
      gone = true;
      leave();
      for (const end of endings) end();
      element.remove();
      layer.remove();
      listeners.clear();
    },
  };
}

function listen(target, name, fn, options) {
  target.addEventListener(name, fn, options);
  return () => target.removeEventListener(name, fn, options);
}

/** "card", "software" (a processor draws, so each point counts), or "none". */
function lookAtGraphics() {
  const context = document.createElement("canvas").getContext("webgl2");
  if (context === null) return "none";
  const names = context.getExtension("WEBGL_debug_renderer_info");
  const name = String(context.getParameter(names?.UNMASKED_RENDERER_WEBGL ?? context.RENDERER));
  context.getExtension("WEBGL_lose_context")?.loseContext();
  return /swiftshader|llvmpipe|softpipe|software|basic render/i.test(name) ? "software" : "card";
}
