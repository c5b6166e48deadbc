/**
 * The 3D view: viser's own page in an iframe of this origin. One view serves all modes.
 *
 * `element` only reserves the view's place in a mode's layout. The iframe is in a layer above it, because an iframe
 * that is moved to another parent is reloaded, which takes seconds. Keys pressed in the iframe go to the page's key
 * table and never to viser, whose W A S D Q E and arrow keys would move the camera.
 */

import { onTheme, themeNow } from "./colors.js";
import { h } from "./dom.js";
import { ApiError } from "./errors.js";
import { createPace } from "./pace.js";
import { createViewportBar } from "./viewport_bar.js";

/** @typedef {{ project: string, scene: Scene3D }} Wanted */

const FOLLOW_MS = 200;
const RETRY_MS = 1500;
const ASK_MS = 800;
// A box that is selected by a double click comes this much later than the click, at most.
const DOUBLE_MS = 1000;
/**
 * What is sent and drawn without a graphics card: at most this number of points, at rest, and while the camera moves this
 * number until frames are measured; and the resolution, relative to the screen's (a setting of viser's page).
 */
const SOFTWARE = { points: 60_000, moving: 60_000, pixels: 0.8 };
/** Variables of viser's shader for points, and their values for squares of one colour: as constants, they cost nothing. */
const PLAIN_SQUARES = [
  ["float point_ball_norm", "1e6"],
  ["mediump float point_shading_enabled", "0.0"],
];
/** Fewer points are no cloud. */
const FEW = 10;
const NO_WEBGL =
  "This browser cannot draw in 3D (no WebGL 2). The image and the views work without it. " +
  "For the 3D view, turn on hardware acceleration or use another browser.";
// hides viser's own panel and notes
const STYLE =
  ".mantine-Paper-root, [data-floating-window], .mantine-Notifications-root { display: none !important; } " +
  "canvas { cursor: default !important; outline: none; }";

export function createViewport(/** @type {Pick<App, "api" | "effort" | "events" | "keys" | "state">} */ app) {
  /** What the mode does that shows the view. @type {ViewportUser | null} */
  let user = null;
  const note = h("p.viewport-note", { role: "status", "data-testid": "viewport-note" });
  const stage = h("div.viewport-stage", { "data-testid": "viewport" }, note);
  const bar = createViewportBar({ change: () => look(null), look });
  const element = h("div.viewport", bar.root, stage);
  const layer = h("div.viewport-layer", { hidden: true }, bar.looks);
  const place = { text: "" };
  /** @type {HTMLIFrameElement | null} */
  let frame = null;
  /** The open viewport of the server. @type {(Api.OpenedViewport & { project: string }) | null} */
  let bench = null;
  /** @type {Wanted | null} */
  let wanted = null;
  /** Where the viewer is to be moved with the next scene that is sent. @type {Api.Look | null} */
  let looking = null;
  /** The scene that the server shows. @type {Wanted | null} */
  let last = null;
  /** Ends when the wanted scene is shown. @type {Promise<void> | null} */
  let working = null;
  /** How often the server has told of the connection. */
  let heard = 0;
  let isHeld = false;
  /** @type {ViewportState} */
  let state = "opening";
  let retry = 0;
  let doubleClickedAt = -Infinity;
  /** The frame whose points are sent ahead. @type {number | null} */
  let ahead = null;

  document.body.append(layer);

  const observer = new ResizeObserver(follow);
  observer.observe(stage);
  setInterval(follow, FOLLOW_MS);
  app.keys.register(bar.keys);
  app.events.on("viewport", receive);
  app.events.on("reconnected", showAgain);
  window.addEventListener("resize", follow);
  window.addEventListener("scroll", follow, { capture: true, passive: true });
  window.addEventListener("pagehide", leave);
  onTheme(() => look(null));
  const graphics = lookAtGraphics();
  const pace = createPace(graphics === "software" ? SOFTWARE.moving : Infinity);
  if (graphics === "none") say("unsupported", NO_WEBGL);

  /** Changes the state; `text` is shown while there is no picture. */
  function say(/** @type {ViewportState} */ next, /** @type {string} */ text = "") {
    state = next;
    note.textContent = text;
    stage.dataset.state = next;
    bar.root.hidden = next === "unsupported";
    follow();
  }

  /** Puts the iframe over its place. Hides it while the place is not on the page, or there is no picture. */
  function follow() {
    const rect = element.isConnected ? stage.getBoundingClientRect() : null;
    const ready = state === "ready";
    const seen = rect !== null && rect.width > 1 && rect.height > 1 && frame !== null && !isHeld;
    const text = seen ? `${rect.left},${rect.top},${rect.width},${rect.height},${ready}` : "";
    if (text === place.text) return;
    place.text = text;
    layer.hidden = !seen;
    if (!seen) return;
    // viser starts only in an iframe that has a size, so until then it is transparent instead of hidden
    layer.style.opacity = ready ? "1" : "0";
    layer.style.pointerEvents = ready ? "auto" : "none";
    const { left, top, width, height } = rect;
    Object.assign(layer.style, { left: `${left}px`, top: `${top}px`, width: `${width}px`, height: `${height}px` });
  }

  /** Shows a scene, in place of older ones that are not shown yet. Must be called again when labels have changed. */
  function show(/** @type {Scene3D} */ scene) {
    const { project } = app.state.route;
    if (state === "unsupported" || project === null) return;
    // the first click of a double click selects a box, and the page hears of it after the second one
    const isDouble = performance.now() - doubleClickedAt < DOUBLE_MS && scene.selected !== last?.scene.selected;
    if (isDouble) looking ??= "focus";
    wanted = { project, scene };
    void work();
  }

  /** Sends the points of the frame that may be shown next, so that the browser only has to draw them. */
  function prepare(/** @type {number} */ next) {
    if (next === ahead) return;
    ahead = next;
    if (last !== null) wanted ??= last;
    void work();
  }

  /** Shows the scene with the present settings, and moves the viewer, also if another scene comes before it is sent. */
  function look(/** @type {Api.Look | null} */ from) {
    looking = from ?? looking;
    const scene = (wanted ?? last)?.scene;
    if (scene) show(scene);
  }

  /** Sends the wanted scene, one request at a time: a newer scene waits for the answer to an older one. */
  function work() {
    working ??= send().finally(() => {
      working = null;
    });
    return working;
  }

  async function send() {
    clearTimeout(retry);
    try {
      while (wanted !== null && !isHeld) await step(wanted);
    } catch (error) {
      if (!(error instanceof ApiError)) throw error;
      if (error.kind === "ViewportClosedError") {
        // the server was restarted, or has closed the viewport because too many were open
        forget();
        again();
      } else {
        say("lost", error.message);
        if (error.status === 0 || error.status >= 500) again();
      }
    }
  }

  async function step(/** @type {Wanted} */ newest) {
    const { project, scene } = newest;
    if (bench !== null && bench.project !== project) leave();
    if (bench === null) {
      say("opening", "Opening the 3D view …");
      const opened = await app.api.post("/api/workbench", { project });
      bench = { project, ...opened };
      return;
    }
    if (frame === null) {
      start(bench.url);
      return;
    }
    const detail = graphics === "software" ? { most_points: SOFTWARE.points } : {};
    const { frame: open, project: info } = app.state;
    const colors = open && info && open.frame.id === scene.frame ? bar.boxColors(info, open.labels) : {};
    const [before, moving] = [heard, looking];
    const content = { ...detail, ...bar.settings, theme: themeNow(), colors, ahead, look: moving, ...scene };
    // the viewer is moved once, not each time that the scene is shown again
    looking = null;
    /** @type {Promise<Api.SceneAnswer>} */
    const asked = app.api.put(`/api/workbench/${bench.id}/scene`, content);
    const answer = await asked.catch((error) => {
      looking ??= moving;
      throw error;
    });
    last = newest;
    if (wanted === newest) wanted = null;
    // what was heard meanwhile is newer
    if (heard === before) connected(answer.connected);
    // the event may be missed while the page's own socket is being opened
    if (!answer.connected) retry = setTimeout(showAgain, ASK_MS);
    pace.moved(performance.now());
    bar.show(answer, Boolean(scene.selected));
  }

  function again() {
    clearTimeout(retry);
    retry = setTimeout(work, RETRY_MS);
  }

  /** Shows the scene again, since a restarted server does not have this viewport. */
  function showAgain() {
    if (last !== null && last.project === app.state.route.project) wanted ??= last;
    void work();
  }

  function connected(/** @type {boolean} */ yes) {
    if (yes) say("ready");
    else if (state === "ready") say("opening", "Reconnecting the 3D view …");
  }

  function receive(/** @type {ViewportMessage} */ message) {
    if (message.workbench !== bench?.id) return;
    if (message.event === "connected") {
      heard += 1;
      connected(message.connected);
    } else if (message.event === "box") user?.onBox(message);
    else user?.onSelect(message.uid);
  }

  /** Makes a new iframe for a new viewport. */
  function start(/** @type {string} */ url) {
    frame?.remove();
    const fresh = h("iframe", { title: "3D view", "data-testid": "viewport-frame", tabindex: "-1" });
    fresh.addEventListener("load", () => equip(fresh));
    fresh.src = graphics === "software" ? `${url}?fixedDpr=${SOFTWARE.pixels}` : url;
    frame = fresh;
    layer.prepend(fresh);
    follow();
  }

  function equip(/** @type {HTMLIFrameElement} */ loaded) {
    // without a server, the browser shows a page of its own, which is out of reach
    const view = loaded.contentDocument?.defaultView;
    if (!view || view.location.href === "about:blank") return;
    const style = view.document.createElement("style");
    style.textContent = STYLE;
    view.document.head.append(style);
    paceDrawing(view);
    app.keys.listen(view);
    app.effort.watch(view);
    // registered after the key table's listener; keeps all keys from viser
    view.addEventListener("keydown", keep, { capture: true });
    view.addEventListener("keyup", keep, { capture: true });
    view.addEventListener("keypress", keep, { capture: true });
  }

  /**
   * Draws no more points than the pace allows, and each of them with as little work as possible: without a graphics
   * card, antialiasing would double a frame's time, and the shader's shapes and shading, which are not used, add a third.
   */
  function paceDrawing(/** @type {Window & typeof globalThis} */ view) {
    const [gl, canvas] = [view.WebGL2RenderingContext.prototype, view.HTMLCanvasElement.prototype];
    const { drawArrays, shaderSource } = gl;
    gl.drawArrays = function (mode, first, count) {
      const isCloud = mode === this.POINTS && count > FEW;
      drawArrays.call(this, mode, first, isCloud ? pace.draw(count, performance.now()) : count);
    };
    // viser applies messages while it draws, after which the old scene is drawn once more; in a hidden tab, at once
    Object.defineProperty(view.document, "hidden", { get: () => true });
    const moved = () => pace.moved(performance.now());
    view.addEventListener("pointermove", ({ buttons }) => buttons > 0 && moved(), { capture: true });
    view.addEventListener("wheel", moved, { capture: true, passive: true });
    view.addEventListener("dblclick", () => {
      doubleClickedAt = performance.now();
      look("focus");
    });
    if (graphics !== "software") return;
    gl.shaderSource = function (shader, source) {
      const plain = PLAIN_SQUARES.reduce(
        (text, [name, value]) => text.replace(`uniform ${name};`, `const ${name} = ${value};`),
        source,
      );
      shaderSource.call(this, shader, plain);
    };
    const getContext = /** @type {(kind: string, settings?: object) => RenderingContext | null} */ (canvas.getContext);
    Object.assign(canvas, {
      /** @this {HTMLCanvasElement} */
      getContext(/** @type {string} */ kind, /** @type {object} */ settings) {
        return getContext.call(this, kind, { ...settings, antialias: false });
      },
    });
  }

  function keep(/** @type {KeyboardEvent} */ event) {
    event.stopImmediatePropagation();
    // keys that scroll the page or leave the iframe
    if (/^( |Arrow.*|Page.*|Home|End)$/.test(event.key)) event.preventDefault();
  }

  function forget() {
    bench = null;
    ahead = null;
    frame?.remove();
    frame = null;
    follow();
  }

  /** Closes the viewport; otherwise the server closes it a minute later. */
  function leave() {
    if (bench === null) return;
    fetch(`/api/workbench/${bench.id}`, { method: "DELETE", keepalive: true, credentials: "same-origin" }).catch(
      () => {},
    );
    forget();
  }

  return {
    show,
    prepare,
    /** Ends when the server has shown the newest scene. */
    idle: () => working ?? Promise.resolve(),
    /** The viewport's id; null before it is open. */
    get id() {
      return bench?.id ?? null;
    },
    get state() {
      return state;
    },
    graphics,
    look,
    showUnlabelled: bar.showUnlabelled,
    /** Puts the view into the page, until `detach`. */
    attach(/** @type {HTMLElement} */ host, /** @type {ViewportUser} */ by) {
      user = by;
      host.append(element);
    },
    /** A view that is not shown yet waits until the returned function is called. */
    hold() {
      isHeld = state !== "ready";
      follow();
      return () => {
        isHeld = false;
        follow();
        void work();
      };
    },
    /** Takes the view out of the page. It stays connected, so it can be shown again at once. */
    detach() {
      if (element.contains(document.activeElement) || document.activeElement === frame) window.focus();
      user = null;
      element.remove();
      follow();
    },
  };
}

/**
 * What renders the view: "card" (a graphics card), "software" (the processor), or "none".
 *
 * @returns {"card" | "software" | "none"}
 */
function lookAtGraphics() {
  const context = document.createElement("canvas").getContext("webgl2");
  if (context === null) return "none";
  const names = context.getExtension("WEBGL_debug_renderer_info");
  const name = String(context.getParameter(names?.UNMASKED_RENDERER_WEBGL ?? context.RENDERER));
  context.getExtension("WEBGL_lose_context")?.loseContext();
  return /swiftshader|llvmpipe|softpipe|software|basic render/i.test(name) ? "software" : "card";
}
