/** Prefetches the next frame while the page is idle, so that server and browser have it in their caches. */

import { isAborted, messageOf } from "../errors.js";

const IDLE_WAIT_MS = 300;

/**
 * requestIdleCallback, or a pause if the browser lacks it.
 *
 * @param {() => void} run
 */
function whenIdle(run) {
  if ("requestIdleCallback" in globalThis) {
    const id = requestIdleCallback(run);
    return () => cancelIdleCallback(id);
  }
  const id = setTimeout(run, IDLE_WAIT_MS);
  return () => clearTimeout(id);
}

/**
 * @param {App} app
 * @param {Order} order
 */
export function createPrefetch(app, order) {
  /** @type {(() => void) | null} */
  let cancel = null;
  /**
   * The frame whose next frame was read.
   *
   * @type {number | null}
   */
  let doneFor = null;

  /**
   * @param {number} shown
   * @param {AbortSignal} signal
   */
  async function run(shown, signal) {
    try {
      const next = await order.next({ signal });
      if (next !== null && next !== shown && !signal.aborted) {
        /** @type {FrameState} */
        const { image } = await app.api.get(app.path("frames", next), { signal });
        // once read to its end, it is in the browser's cache
        const picture = await fetch(image.url, { signal, priority: "low", credentials: "same-origin" });
        await picture.blob();
      }
      doneFor = shown;
    } catch (error) {
      // the problem is shown when that frame is opened
      if (!isAborted(error)) console.debug(`reading ahead: ${messageOf(error)}`);
    }
  }

  function stop() {
    cancel?.();
    cancel = null;
  }

  return {
    /** Begins as soon as the page is idle, once for each frame. */
    start() {
      stop();
      const shown = app.state.frame?.frame.id;
      if (shown === undefined || shown === doneFor) return;
      const request = new AbortController();
      const forget = whenIdle(() => void run(shown, request.signal));
      cancel = () => {
        forget();
        request.abort();
      };
    },
    /** Prefetches again after a change of the order, since another frame may be next. */
    restart() {
      doneFor = null;
      this.start();
    },
    stop,
  };
}
