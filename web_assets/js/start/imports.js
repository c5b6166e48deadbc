/** The boxes of recordings that are being read: the start page has no project open, so nobody tells it of them. */

import { isActive } from "../jobs.js";

/** Boxes of a small recording are read at once, those of a large one for minutes: each look waits longer than the one before. */
const WAIT_MS = { first: 700, longest: 5000, growth: 1.5 };

/**
 * Asks for the jobs, once and then as long as boxes are read.
 *
 * @param {() => void} onDone some have been read.
 * @returns {() => void} ends it.
 */
export function followImports(app, onDone) {
  let is_over = false;
  let timer = 0;
  let wait_ms = WAIT_MS.first;
  const isImport = (job) => job.kind === "import" && isActive(job);
  const running = () => app.state.jobs.filter(isImport).map(({ id }) => id);

  function plan() {
    clearTimeout(timer);
    const is_running = running().length > 0 && !is_over;
    timer = is_running ? setTimeout(look, wait_ms) : 0;
    wait_ms = is_running ? Math.min(wait_ms * WAIT_MS.growth, WAIT_MS.longest) : WAIT_MS.first;
  }

  async function look() {
    const before = running();
    try {
      const { jobs } = await app.api.get("/api/jobs");
      if (is_over) return;
      // what was begun since the question is not in the answer
      const begun = app.state.jobs.filter((job) => isImport(job) && !jobs.some(({ id }) => id === job.id));
      app.state.set({ jobs: [...begun, ...jobs] });
    } catch {
      // the page says by itself that the server does not answer
    }
    plan();
    if (!is_over && before.some((id) => !running().includes(id))) onDone();
  }

  const stop = app.state.on("jobs", () => timer || plan());
  void look();
  return () => {
    is_over = true;
    plan();
    stop();
  };
}
