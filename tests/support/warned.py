"""What is logged while a case renders."""

from __future__ import annotations

import mitsuba as mi


class Warned:
    """Collects what is logged as a warning while it is entered."""

    def __enter__(self) -> list[str]:
        texts = []

        class Appender(mi.Appender):
            def append(self, level, text):
                if level == mi.LogLevel.Warn and "bdpt:" in text:
                    texts.append(text.partition("bdpt: ")[2])

            def log_progress(self, *_):
                pass

        self._appender = Appender()
        mi.logger().add_appender(self._appender)
        return texts

    def __exit__(self, *_):
        mi.logger().remove_appender(self._appender)
