/** The next frame is asked for while nothing else is to do, so that server and browser have it at hand. */

const IDLE_WAIT_MS = 300;

/** requestIdleCallback, where a browser lacks it a pause. */
function whenIdle(run) {
  if (globalThis.requestIdleCallback) {
    const id = requestIdleCallback(run);
    return () => cancelIdleCallback(id);
  }
  const id = setTimeout(run, IDLE_WAIT_MS);
  return () => clearTimeout(id);
}

/** @param {object} order says which frame is next (order.js). */
export function createPrefetch(app, order) {
  let cancel = null;
  /** The frame that is shown, and whether what follows it is at hand. */
  let done_for = null;

  async function run(shown, signal) {
    try {
      const next = await order.next({ signal });
      if (next !== null && next !== shown && !signal.aborted) {
        const { image } = await app.api.get(app.path("frames", next), { signal });
        // Read to its end, it is in the browser's cache.
        const picture = await fetch(image.url, { signal, priority: "low", credentials: "same-origin" });
        await picture.blob();
      }
      done_for = shown;
    } catch (error) {
      // Whoever opens that frame is told what is wrong with it.
      if (error.name !== "AbortError") console.debug(`reading ahead: ${error.message}`);
    }
  }

  function stop() {
    cancel?.();
    cancel = null;
  }

  return {
    /** Begins as soon as there is time; once a frame is enough. */
    start() {
      stop();
      const shown = app.state.frame?.frame.id;
      if (shown === undefined || shown === done_for) return;
      const request = new AbortController();
      const forget = whenIdle(() => void run(shown, request.signal));
      cancel = () => {
        forget();
        request.abort();
      };
    },
    /** Another order: another frame is next. */
    restart() {
      done_for = null;
      this.start();
    },
    stop,
  };
}
