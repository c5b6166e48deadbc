/** Who works here: a name at sign-in, which every label event then carries. */

import { openDialog } from "./dialogs.js";
import { h } from "./dom.js";

let asking = null;

/** Asks for a name until the server takes one. Two calls at once share one dialog. */
export function signIn(app) {
  asking ??= ask(app).finally(() => (asking = null));
  return asking;
}

async function ask(app) {
  const field = h("input", { name: "operator", required: true, maxlength: 60, autocomplete: "username", autofocus: true, value: localStorage.getItem("operator") ?? "", "data-testid": "operator-name" });
  const session = await openDialog({
    title: "Sign in",
    content: [
      h("p", {}, "Each box that you draw or accept carries your name, so that several people can share a project."),
      h("label", { class: "field" }, h("span", {}, "Your name"), field),
    ],
    actions: [{ label: "Start", value: "start" }],
    required: true,
    testid: "sign-in",
    async submit() {
      const operator = field.value.trim();
      if (!operator) throw new Error("Please enter a name.");
      return app.api.post("/api/session", { operator });
    },
  });
  localStorage.setItem("operator", session.operator);
  app.state.set({ operator: session.operator });
  return session;
}

/** Forgets the name and asks again. */
export async function signOut(app) {
  await app.api.del("/api/session");
  app.state.set({ operator: null });
  await signIn(app);
  location.reload();
}
