/** The operator, who signs in with a name, which is stored with every change. */

import { openDialog } from "./dialogs.js";
import { h } from "./dom.js";
import { field } from "./forms.js";

/** @type {Promise<void> | null} */
let asking = null;

/** Asks for a name until the server accepts one. Concurrent calls share one dialog. */
export function signIn(/** @type {App} */ app) {
  asking ??= ask(app).finally(() => {
    asking = null;
  });
  return asking;
}

async function ask(/** @type {App} */ app) {
  const name = h("input", {
    name: "operator",
    required: true,
    maxlength: 60,
    autocomplete: "username",
    autofocus: true,
    value: localStorage.getItem("operator") ?? "",
    "data-testid": "operator-name",
  });
  const session = await openDialog({
    title: "Sign in",
    content: [
      h("p", "Your name is kept with each box that you draw or accept, so that several people can share a project."),
      field("Your name", name),
    ],
    actions: [{ label: "Start", value: "start" }],
    required: true,
    testid: "sign-in",
    /** @returns {Promise<Api.Session>} */
    async submit() {
      const operator = name.value.trim();
      if (!operator) throw new Error("Please enter a name.");
      return app.api.post("/api/session", { operator });
    },
  });
  if (!session?.operator) return;
  localStorage.setItem("operator", session.operator);
  app.state.set({ operator: session.operator });
}

/** Forgets the name and asks again. */
export async function signOut(/** @type {App} */ app) {
  await app.api.del("/api/session");
  app.state.set({ operator: null });
  await signIn(app);
  location.reload();
}
