// Equations that pymdownx.arithmatex has marked, rendered by the KaTeX beside this file: on every page, also without a network.
const render = () => {
  for (const element of document.querySelectorAll(".arithmatex")) {
    renderMathInElement(element, {
      delimiters: [
        { left: "\\(", right: "\\)", display: false },
        { left: "\\[", right: "\\]", display: true },
      ],
      throwOnError: false,
    });
  }
};
typeof document$ === "undefined" ? document.addEventListener("DOMContentLoaded", render) : document$.subscribe(render);
