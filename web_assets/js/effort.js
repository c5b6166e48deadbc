/**
 * The effort that labels cost, measured as for the annotation tool SAnE: actions, and seconds of work.
 *
 * An action is one finished drag, key press or click that changes something; viewing does not count.
 * Time is counted from one input event (pointer, wheel, key) to the next, and each pause counts as at most 30 s. The
 * effort that the server has acknowledged is subtracted, so that nothing is counted twice or lost with a refused
 * request.
 */

const LONGEST_PAUSE_S = 30;
const SIGNS = ["pointerdown", "pointermove", "wheel", "keydown"];

export function createEffort(now = () => performance.now() / 1000) {
  let actions = 0;
  let seconds = 0;
  let lastS = now();

  function alive() {
    const time = now();
    seconds += Math.min(time - lastS, LONGEST_PAUSE_S);
    lastS = time;
  }

  return {
    /** One more action, or several. */
    action(n = 1) {
      alive();
      actions += n;
    },

    /** Counts the time since the last input event. */
    alive,

    /** Listens to the input events of a window. */
    watch(/** @type {Window} */ target) {
      for (const name of SIGNS) target.addEventListener(name, alive, { capture: true, passive: true });
    },

    /** The effort so far, to be sent with a change. */
    peek() {
      alive();
      return { actions, seconds: Math.round(seconds * 1000) / 1000 };
    },

    /** Subtracts what the server has acknowledged. */
    acknowledge(/** @type {Api.Effort} */ sent) {
      actions = Math.max(0, actions - sent.actions);
      seconds = Math.max(0, seconds - sent.seconds);
    },

    /** Discards the effort so far, which does not belong to the next frame's objects. */
    reset() {
      actions = 0;
      seconds = 0;
      lastS = now();
    },
  };
}
