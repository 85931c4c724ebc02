// Invitations: the page's address as QR code and text, and the steps with which a phone trusts the page's certificate.
// Loaded on demand.
import { setAttribute, createElement, setText } from "./element.js";
import { send } from "./connection.js";
import { formatMoment, text } from "./texts.js";

const KINDS = { phone: "invite.phone", viewer: "invite.viewer" };
const DRAWINGS = "image/svg+xml";

const STEPS = {
  "Android (Chrome)": ["invite.android.download", "invite.android.settings", "invite.android.choose"],
  "iPhone, iPad (Safari)": ["invite.ios.download", "invite.ios.install", "invite.ios.trust"],
};

// Load the style sheet before the QR code is shown.
let styleLoaded;
function loadStyle() {
  styleLoaded ??= new Promise((done) => {
    const sheet = createElement("link", { rel: "stylesheet", href: "/static/invite.css" });
    sheet.onload = sheet.onerror = done;
    document.head.append(sheet);
  });
  return styleLoaded;
}

// Show the SVG that the node drew; hide the element if the node lacks the library for QR codes.
function showQrCode(figure, svg, label) {
  figure.hidden = !svg;
  if (!svg) return;
  const drawing = document.importNode(new DOMParser().parseFromString(svg, DRAWINGS).documentElement, true);
  setAttribute(drawing, "role", "img");
  setAttribute(drawing, "aria-label", label);
  figure.replaceChildren(drawing);
}

// A text with a copy button; over http, where browsers offer no clipboard API, with execCommand.
function createCopyField(label, id, tell) {
  const field = createElement("input", { id, readonly: "" });
  const button = createElement("button", { type: "button" }, text("invite.copy"));
  button.onclick = async () => {
    field.select();
    const done = navigator.clipboard ? await navigator.clipboard.writeText(field.value).then(() => true, () => false) : document.execCommand("copy");
    tell(text(done ? "invite.copied" : "invite.copy_yourself"));
  };
  return [field, createElement("div", {}, createElement("label", { for: id }, label), createElement("div", { class: "row" }, field, button))];
}

function createSteps() {
  return Object.entries(STEPS).map(([name, lines]) =>
    createElement("details", {}, createElement("summary", {}, name), createElement("ol", {}, ...lines.map((key) => createElement("li", {}, text(key))))));
}

function createDialog() {
  const line = createElement("p", { role: "status" });
  const tell = (message) => setText(line, message);
  const parts = {
    line, tell,
    kind: createElement("select", { id: "i-kind" }),
    page: createElement("select", { id: "i-page" }),
    code: createElement("figure", { class: "code" }),
    hint: createElement("p"),
    alone: createElement("p", { class: "warn" }),
    plain: createElement("p", { class: "warn" }),
    close: createElement("button", { type: "button" }, text("action.close")),
    authority: createElement("figure", { class: "code" }),
    mark: createElement("p", { class: "mark" }),
  };
  const [link, linkRow] = createCopyField(text("invite.link"), "i-link", tell);
  const [certificate, certificateRow] = createCopyField(text("invite.certificate"), "i-certificate", tell);
  const trust = createElement("section", { class: "trust" },
    createElement("h3", {}, text("invite.warning_title")),
    createElement("p", {}, text("invite.warning")), createElement("p", {}, text("invite.warning_trust")),
    ...createSteps(), parts.authority, certificateRow, parts.mark);
  const choices = createElement("div", { class: "choices" },
    createElement("div", {}, createElement("label", { for: "i-kind" }, text("invite.purpose")), parts.kind),
    createElement("div", {}, createElement("label", { for: "i-page" }, text("invite.address")), parts.page));
  const dialog = createElement("dialog", { id: "invite", "aria-labelledby": "h-invite" },
    createElement("div", { class: "bar" }, createElement("h2", { id: "h-invite" }, text("invite.title")), parts.close),
    choices, parts.alone, parts.plain, parts.code, linkRow, parts.hint, line, trust);
  return { ...parts, link, certificate, trust, dialog };
}

function setOptions(select, entries, chosen) {
  select.replaceChildren(...entries.map(([value, name]) => createElement("option", { value }, name)));
  select.value = chosen;
}

function show(parts, invitation, role) {
  const isHere = invitation.reaches === "machine";
  parts.alone.hidden = !isHere;
  setText(parts.alone, isHere ? text("invite.machine_only") : "");
  showQrCode(parts.code, isHere ? "" : invitation.code, text("invite.code_label"));
  parts.link.value = invitation.link;
  const use = text(isHere ? "invite.use_here" : "invite.use");
  setText(parts.hint, `${use} ${text(role === "phone" ? "invite.allows_phone" : "invite.allows_viewer", { time: formatMoment(invitation.until) })}`);
  parts.plain.hidden = invitation.is_secure || role !== "phone";
  setText(parts.plain, text(invitation.certificate ? "invite.choose_https" : "invite.no_https"));
  parts.trust.hidden = !invitation.is_secure || isHere;
  showQrCode(parts.authority, invitation.certificate_code, text("invite.certificate_label"));
  parts.certificate.value = invitation.certificate;
  setText(parts.mark, text("invite.fingerprint", { fingerprint: invitation.fingerprint }));
}

export async function openInvitation(model) {
  await loadStyle();
  const parts = createDialog();
  const kinds = Object.entries(KINDS).filter(([role]) => role !== "phone" || model.has.includes("phones"));
  setOptions(parts.kind, kinds.map(([role, key]) => [role, text(key)]), kinds[0][0]);
  async function invite() {
    const role = parts.kind.value;
    parts.tell("");
    try {
      const invitation = await send("POST", "invitations", { role, draw: true, page: parts.page.value });
      // A node that does not know its URLs was at least reached by this address.
      invitation.link ??= `${location.origin}/#code=${invitation.token}${role === "phone" ? "/phone" : ""}`;
      invitation.pages ??= [location.origin];
      if (!parts.page.options.length) setOptions(parts.page, invitation.pages.map((url) => [url, url]), invitation.pages[0]);
      show(parts, invitation, role);
    } catch (error) {
      parts.tell(error.message);
    }
  }
  parts.kind.onchange = invite;
  parts.page.onchange = invite;
  parts.close.onclick = () => parts.dialog.close();
  parts.dialog.onclose = () => parts.dialog.remove();
  await invite();
  document.body.append(parts.dialog);
  parts.dialog.showModal();
}
