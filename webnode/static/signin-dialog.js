// The sign-in dialog: asks for the code or password until one is accepted; loaded if the visitor is not signed in.
import { createElement, setText } from "./element.js";

// Resolve when `signIn` accepts the input; `trouble` is shown first.
export function showSignInDialog(trouble, signIn) {
  return new Promise((done) => {
    const line = createElement("p", { role: "alert" }, trouble);
    const field = createElement("input", { id: "signin-code", type: "password", autocomplete: "current-password", maxlength: 300, required: "" });
    const show = createElement("button", { type: "button", "aria-pressed": "false" }, "Show");
    const enterButton = createElement("button", { class: "primary" }, "Sign in");
    const form = createElement("form", {},
      createElement("h2", { id: "h-signin" }, "Sign in"),
      createElement("p", { class: "hint" }, "The node prints the code when it starts; the command swarm web shows it, too."),
      createElement("label", { for: "signin-code" }, "Code or password"),
      createElement("div", { class: "row" }, field, show), line, enterButton);
    const dialog = createElement("dialog", { id: "signin", "aria-labelledby": "h-signin", closedby: "none" }, form);
    show.onclick = () => {
      const hidden = field.type === "password";
      field.type = hidden ? "text" : "password";
      setText(show, hidden ? "Hide" : "Show");
      show.setAttribute("aria-pressed", String(hidden));
    };
    // The page behind the dialog cannot be used, so it stays open.
    dialog.oncancel = (event) => event.preventDefault();
    dialog.onclose = () => { if (dialog.isConnected) dialog.showModal(); };
    form.onsubmit = async (event) => {
      event.preventDefault();
      enterButton.disabled = true;
      setText(line, "");
      try {
        await signIn(field.value);
        dialog.remove();
        done();
      } catch (error) {
        setText(line, error.message);
        field.select();
      }
      enterButton.disabled = false;
    };
    document.body.append(dialog);
    dialog.showModal();
  });
}
