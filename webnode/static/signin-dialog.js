// The sign-in dialog: asks for the code or password until one is accepted; loaded if the visitor is not signed in.
import { createElement, setText } from "./element.js";
import { text } from "./texts.js";

// Resolve when `signIn` accepts the input; `trouble` is shown first.
export function showSignInDialog(trouble, signIn) {
  return new Promise((done) => {
    const line = createElement("p", { role: "alert" }, trouble);
    const field = createElement("input", { id: "signin-code", type: "password", autocomplete: "current-password", maxlength: 300, required: "" });
    const show = createElement("button", { type: "button", "aria-pressed": "false" }, text("signin.show"));
    const enterButton = createElement("button", { class: "primary" }, text("signin.submit"));
    const form = createElement("form", {},
      createElement("h2", { id: "h-signin" }, text("signin.title")),
      createElement("p", { class: "hint" }, text("signin.hint")),
      createElement("label", { for: "signin-code" }, text("signin.code")),
      createElement("div", { class: "row" }, field, show), line, enterButton);
    const dialog = createElement("dialog", { id: "signin", "aria-labelledby": "h-signin", closedby: "none" }, form);
    show.onclick = () => {
      const hidden = field.type === "password";
      field.type = hidden ? "text" : "password";
      setText(show, text(hidden ? "signin.hide" : "signin.show"));
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
