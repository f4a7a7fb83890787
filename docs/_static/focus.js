// What scrolls by itself is reached with the keyboard.
addEventListener("load", () => {
  for (const element of document.querySelectorAll(".highlight pre, .table-wrapper, .math-wrapper, .output pre, .content p")) {
    const {scrollWidth, clientWidth, scrollHeight, clientHeight} = element;
    if (scrollWidth > clientWidth || scrollHeight > clientHeight) element.tabIndex = 0;
  }
});
