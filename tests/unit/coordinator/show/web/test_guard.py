"""Who may look at the page, and what every answer says."""

from __future__ import annotations

import pytest

from tests.support.served import HOST, client, played

TOKEN = "0123456789abcdef"


@pytest.mark.parametrize("path", ["/", "/api/now", "/api/nothing", "/static/main.js", "/static/../app.py", "/health"])
def test_every_answer_says_what_a_page_may_do(path: str):
    headers = client(played()).get(path).headers
    policy = headers["content-security-policy"]
    assert "default-src 'none'" in policy
    assert "unsafe" not in policy
    assert headers["x-content-type-options"] == "nosniff"
    assert headers["referrer-policy"] == "no-referrer"


@pytest.mark.parametrize("host", ["evil.example", "127.0.0.1:9", "127.0.0.1", f"{HOST}.evil.example", "[::1]:8080"])
def test_a_page_that_is_asked_for_under_another_name_is_not_shown(host: str):
    answer = client(played()).get("/api/now", headers={"host": host})
    assert answer.status_code == 421
    assert "vm_pu" not in answer.text


@pytest.mark.parametrize(
    "origin", ["https://evil.example", "null", "http://127.0.0.1:9", f"http://{HOST}.evil.example"]
)
def test_pages_of_other_sites_are_sent_nothing(origin: str):
    answer = client(played()).get("/api/now", headers={"origin": origin})
    assert (answer.status_code, "vm_pu" in answer.text) == (403, False)


def test_the_page_itself_may_name_its_origin():
    assert client(played()).get("/api/now", headers={"origin": f"http://{HOST}"}).status_code == 200


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "PATCH", "OPTIONS"])
def test_nothing_can_be_changed(method: str):
    assert client(played()).request(method, "/api/now").status_code == 405


@pytest.mark.parametrize("path", ["/", "/api/now", "/api/stream", "/static/main.js", "/health"])
@pytest.mark.parametrize(
    "headers",
    [
        {},
        {"authorization": "Bearer wrong"},
        {"cookie": "dsse-token=wrong"},
        {"cookie": "dsse-token=\x7f;;;=="},
        {"authorization": "Bearer "},
    ],
)
def test_without_the_token_nothing_is_shown(path: str, headers: dict[str, str]):
    assert client(played(), TOKEN).get(path, headers=headers).status_code == 401


def test_a_token_in_the_address_becomes_a_cookie_that_scripts_do_not_see():
    shown = client(played(), TOKEN)
    answer = shown.get(f"/?token={TOKEN}")
    assert (answer.status_code, answer.headers["location"]) == (303, "/")
    cookie = answer.headers["set-cookie"].lower()
    assert all(word in cookie for word in ("httponly", "secure", "samesite=strict"))
    assert shown.get("/api/now", headers={"cookie": f"dsse-token={TOKEN}"}).status_code == 200
    assert shown.get("/api/now", headers={"authorization": f"Bearer {TOKEN}"}).status_code == 200
    assert shown.get("/api/now?token=" + TOKEN).status_code == 401  # only the page itself takes it
